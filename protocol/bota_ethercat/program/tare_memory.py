# SPDX-License-Identifier: Apache-2.0
"""What a tare changed last in each sensor, so that it can be undone: `tares.json`, by serial number."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any, Final

from bota_ethercat.control import SIX_NUMBERS
from bota_ethercat.program import state

_NAME: Final = "tares.json"
_INSTEAD: Final = "clear the offset, or tare again"


def remember(serial: int, before: Sequence[float], after: Sequence[float]) -> None:
    """Keep both offsets, in N and Nm, in place of earlier ones; OSError if they cannot be written."""
    path = state.folder() / _NAME
    state.write(path, {**state.read(path), str(serial): {"before": list(before), "after": list(after)}})


def former(serial: int | None, now: Sequence[float], sensor: str) -> list[float]:
    """The offset of before the last tare of `sensor`; ValueError unless that tare made the offset `now`."""
    row: Any = state.read(state.folder() / _NAME).get(str(serial))
    try:
        before, after = SIX_NUMBERS.check(row["before"]), SIX_NUMBERS.check(row["after"])
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"no tare of {sensor} by this user is known; {_INSTEAD}") from None
    if array("f", after) != array("f", now):  # as the sensor keeps it
        raise ValueError(f"the offset of {sensor} has changed since its last tare here; {_INSTEAD}")
    return list(before)
