# SPDX-License-Identifier: Apache-2.0
"""What a tare changed last in each sensor, so that it can be undone: a file of this user's, by serial number.

$XDG_STATE_HOME/bota-ethercat-bridge/tares.json, or below ~/.local/state.
"""

from __future__ import annotations

import json
import os
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bota_ethercat.control import six_numbers


def remember(serial: int, before: Sequence[float], after: Sequence[float]) -> None:
    """Keep both offsets, in N and Nm, in place of earlier ones; OSError if they cannot be written."""
    path = _path()
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {**_read(path), str(serial): {"before": list(before), "after": list(after)}}
    unfinished = path.with_suffix(f".{os.getpid()}")
    unfinished.write_text(json.dumps(kept), encoding="utf-8")
    unfinished.replace(path)


def former(serial: int | None, now: Sequence[float], sensor: str) -> list[float]:
    """The offset of before the last tare of `sensor`; ValueError unless that tare made the offset `now`."""
    row: Any = _read(_path()).get(str(serial))
    try:
        before, after = six_numbers(row["before"]), six_numbers(row["after"])
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"no tare of {sensor} by this user is known") from None
    if array("f", after) != array("f", now):  # as the sensor keeps it
        raise ValueError(f"the offset of {sensor} has changed since its last tare here")
    return list(before)


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
