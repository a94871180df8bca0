# SPDX-License-Identifier: Apache-2.0
"""One accounting of a stream: what each DATA frame is, and what is missing before it. No sockets, no clock.

docs/protocol.md defines the words; the C++ header counts the same, and tests/protocol/golden/accounting.json
holds both to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from bota_ethercat.framing import DataFlag

# Either of these flags says that a frame brings no new sample.
NOT_NEW: Final = int(DataFlag.REPEATED | DataFlag.INVALID)
_INVALID: Final = int(DataFlag.INVALID)
_GAP: Final = int(DataFlag.GAP)


class FrameKind(Enum):
    """What a frame is."""

    NEW = auto()
    REPEATED = auto()
    INVALID = auto()
    OLD = auto()


@dataclass(slots=True)
class StreamCounts:
    """Counts of one sensor's frames and samples."""

    new: int = 0  # frames with one new, valid sample
    repeated: int = 0  # frames: the sensor has nothing new
    invalid: int = 0  # frames: the working counter was short
    old: int = 0  # duplicates, and frames out of order; they change no other count
    restarts: int = 0  # the server's numbering began again
    gaps: int = 0  # frames with GAP
    withheld: int = 0  # sequence numbers of frames that this client did not read in time
    lost: int = 0  # samples that the server never had, so they have no number
    skipped: int = 0  # sequence numbers that the subscription left out

    @property
    def frames(self) -> int:
        """All frames received."""
        return self.new + self.repeated + self.invalid + self.old

    @property
    def missing(self) -> int:
        """Samples that this client should have and has not: lost and withheld."""
        return self.lost + self.withheld


class StreamAccounting:
    """Classifies and counts the frames of one sensor."""

    __slots__ = (
        "_every", "_fresh_only", "_missed", "_missed_since", "_monotonic_ns", "_sequence",
        "counts", "new_ns", "rate_hz",
    )  # fmt: skip

    def __init__(
        self, counts: StreamCounts | None = None, *, every: int = 1, fresh_only: bool = True
    ) -> None:
        """`every` and `fresh_only` as subscribed; `counts` to add to, by default new ones."""
        self.counts: StreamCounts = StreamCounts() if counts is None else counts
        self.rate_hz = 0.0  # the sensor's sampling rate; 0 if it is unknown
        self.new_ns = -1  # `monotonic_ns` of the newest new frame; -1: none since the subscription began
        self._every = every
        self._fresh_only = fresh_only
        self.begin()

    def begin(self) -> None:
        """A new subscription begins: nothing before its first frame counts as missing, unless it has GAP."""
        self._sequence = self._monotonic_ns = self.new_ns = -1
        self._missed = self._missed_since = 0  # missing already, since there were so many new frames

    @property
    def has_begun(self) -> bool:
        """Whether a frame has come since `begin`."""
        return self._sequence >= 0

    def count_next(self, sequence: int, monotonic_ns: int) -> bool:
        """Count a frame without flags that is the one after the last, as nearly all are; False: not so."""
        if sequence != self._sequence + 1:
            return False
        self._sequence = sequence
        self._monotonic_ns = self.new_ns = monotonic_ns
        self.counts.new += 1
        return True

    def count_run(self, last: int) -> int:
        """Count the frames before the one of this number, all without flags and next; how many."""
        frames = last - 1 - self._sequence
        self._sequence += frames
        self.counts.new += frames
        return frames

    def count(self, sequence: int, monotonic_ns: int, flags: int) -> FrameKind:
        """Count the next frame; what it is."""
        counts, jump = self.counts, 0
        if sequence > self._sequence:
            jump = sequence - self._sequence - 1 if self._sequence >= 0 else 0
        elif monotonic_ns > self._monotonic_ns:
            counts.restarts += 1
        else:
            counts.old += 1
            return FrameKind.OLD
        if jump or flags & _GAP:
            self._count_missing(jump, monotonic_ns, flags & _GAP)
        self._sequence, self._monotonic_ns = sequence, monotonic_ns
        if flags & NOT_NEW:
            if flags & _INVALID:
                counts.invalid += 1
                return FrameKind.INVALID
            counts.repeated += 1
            return FrameKind.REPEATED
        counts.new += 1
        self.new_ns = monotonic_ns
        return FrameKind.NEW

    def _count_missing(self, jump: int, monotonic_ns: int, gap: int) -> None:
        counts = self.counts
        skipped = jump if self._fresh_only and not gap else min(jump, self._every - 1)
        counts.skipped += skipped
        counts.withheld += jump - skipped
        if not gap:
            return
        counts.gaps += 1
        lost = 0 if jump > skipped else 1
        missed = jump + (self._missed if self._missed_since == counts.new else 0)
        if self.new_ns >= 0 and self.rate_hz:
            room = round((monotonic_ns - self.new_ns) * self.rate_hz / 1e9) - 1
            lost = max(lost, room - missed)
        counts.lost += lost
        self._missed, self._missed_since = missed + lost, counts.new
