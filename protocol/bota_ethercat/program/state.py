# SPDX-License-Identifier: Apache-2.0
"""What programs keep between their runs: JSON objects in files of this user's, or of the service's."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from bota_ethercat.program.new_file import where_supported

_MAX_SIZE: Final = 1 << 20  # bytes that a file may have


def folder() -> Path:
    """$STATE_DIRECTORY, which systemd gives a service, else in $XDG_STATE_HOME or ~/.local/state."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given)
    base = os.environ.get("XDG_STATE_HOME", "")
    if not base.startswith("/"):
        with contextlib.suppress(RuntimeError):  # a user without a home: nothing is kept
            base = f"{Path.home()}/.local/state"
    return Path(base or "/nonexistent") / "bota-ethercat-bridge"


def read(path: Path) -> dict[str, Any]:
    """The object, which may be another program's; empty if there is none."""
    try:
        if not path.is_file() or path.stat().st_size > _MAX_SIZE:
            return {}
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def write(path: Path, kept: dict[str, Any]) -> None:
    """See `replace`."""
    replace(path, [json.dumps(kept).encode()])


def replace(path: Path, parts: Iterable[bytes]) -> None:
    """Replace the file as a whole, also if power is cut; OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(f".{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            file.writelines(parts)
            file.flush()
            with where_supported():
                os.fsync(file.fileno())
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
