"""What the reader's hot path notes for the diagnostics: the sensor's flags and the samples' ages. No locks.

The reader appends, the monitor takes; a deque's append and popleft are atomic.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import LAYOUTS, Sample

_MOST_AGES: Final = 8192
_MOST_CHANGES: Final = 8192


class Flags(NamedTuple):
    """The fields of the process data that say how the sensor is."""

    status: int = 0
    warnings: int = 0
    force_torque_saturated: int = 0
    acceleration_saturated: int = 0
    angular_rate_saturated: int = 0

    def merge(self, other: tuple[int, ...]) -> Flags:
        """What is set in either."""
        return Flags(*(mine | theirs for mine, theirs in zip(self, other, strict=True)))


_BASE: Final = LAYOUTS[min(LAYOUTS)]
_FLAGS: Final = struct.Struct(
    "<" + "".join(f.type.value if f.name in Flags._fields else f"{f.type.size}x" for f in _BASE.fields)
)
"""Of every size of process data, which all begin alike: the flags, and nothing of the rest."""


_FORCE_TORQUE: Final = Flags._fields.index("force_torque_saturated")


class Watch:
    """`see` is for the reader, `take_flags` and `take_ages` are for the monitor."""

    def __init__(self) -> None:
        self._seen: tuple[int, ...] = tuple(Flags())
        self._current: tuple[int, ...] = self._seen
        self._changes: deque[tuple[int, ...]] = deque(maxlen=_MOST_CHANGES)
        self.ages: deque[int] = deque(maxlen=_MOST_AGES)
        """Nanoseconds from a sample to the end of its publication, newest last."""
        self.sample: Sample | None = None
        """The newest sample that was published."""
        self.stamp_ns = 0
        """Its time, ns since the Unix epoch."""
        self.saturated = 0
        """Samples whose force or torque was saturated."""

    def see(self, frames: Sequence[DataMessage]) -> None:
        """Note the flags of new frames, whether they are to be published or not."""
        for frame in frames:
            flags = _FLAGS.unpack_from(frame.process_data)
            if flags != self._seen:
                self._seen = flags
                self._changes.append(flags)
            if flags[_FORCE_TORQUE]:
                self.saturated += 1

    def take_flags(self) -> Flags:
        """All that were set since the last call, if only for one frame, and those that are set now."""
        merged = Flags(*self._current)
        while self._changes:
            self._current = self._changes.popleft()
            merged = merged.merge(self._current)
        return merged

    def take_ages(self) -> list[int]:
        """The ages since the last call, in ascending order."""
        taken, self.ages = self.ages, deque(maxlen=_MOST_AGES)
        return sorted(taken)
