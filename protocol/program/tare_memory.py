"""What a tare changed last in each sensor, so that it can be undone: a file of this user's, by serial number.

$XDG_STATE_HOME/bota-ethercat-bridge/tares.json, or below ~/.local/state.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Tared(NamedTuple):
    """Force/torque offsets of a sensor, in N and Nm."""

    before: list[float]
    after: list[float]


def remember(serial: int, tared: Tared) -> None:
    """Keep it in place of an earlier one; OSError if it cannot be written."""
    path = _path()
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {**_read(path), str(serial): tared._asdict()}
    unfinished = path.with_suffix(f".{os.getpid()}")
    unfinished.write_text(json.dumps(kept), encoding="utf-8")
    unfinished.replace(path)


def recall(serial: int) -> Tared | None:
    """What was kept; None if there is nothing, or nothing that makes sense."""
    row = _read(_path()).get(str(serial))
    if not isinstance(row, dict) or not _are_offsets(row.get("before")) or not _are_offsets(row.get("after")):
        return None
    return Tared(row["before"], row["after"])


def _path() -> Path:
    state = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(state) if state.startswith("/") else Path("~/.local/state").expanduser()
    return folder / "bota-ethercat-bridge" / "tares.json"


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _are_offsets(value: object) -> bool:
    return (
        isinstance(value, Sequence)
        and len(value) == 6
        and all(isinstance(number, float) and math.isfinite(number) for number in value)
    )
