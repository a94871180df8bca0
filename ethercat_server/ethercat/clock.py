"""Clocks and waiting; tests replace them by simulated time."""

from __future__ import annotations

import time
from typing import Final, Protocol

_READS: Final = 5


class Clock(Protocol):
    """CLOCK_MONOTONIC for intervals, CLOCK_REALTIME for stamps, and waiting."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""

    def time_ns(self) -> int:
        """CLOCK_REALTIME, ns."""

    def sleep(self, seconds: float, /) -> None:
        """Return after `seconds` at the earliest."""


SYSTEM_CLOCK: Final[Clock] = time  # the kernel's clocks


class RealtimeOffset:
    """CLOCK_REALTIME less CLOCK_MONOTONIC, in ns.

    It is constant until CLOCK_REALTIME is set: the kernel slews both alike. So that it does not depend on
    what comes between two clock reads, CLOCK_REALTIME is read between two reads of CLOCK_MONOTONIC.
    """

    def __init__(self, clock: Clock) -> None:
        self._monotonic_ns, self._time_ns = clock.monotonic_ns, clock.time_ns
        self.ns = self._middle()

    def follow(self) -> None:
        """To be called regularly: notices that CLOCK_REALTIME was set."""
        least, most = self._bounds()
        if not least <= self.ns <= most:
            self.ns = self._middle()

    def _bounds(self) -> tuple[int, int]:
        before_ns, time_ns, after_ns = self._monotonic_ns(), self._time_ns(), self._monotonic_ns()
        return time_ns - after_ns, time_ns - before_ns

    def _middle(self) -> int:
        least, most = min((self._bounds() for _ in range(_READS)), key=lambda bounds: bounds[1] - bounds[0])
        return (least + most) // 2


class Deadline:
    """The instant `seconds` from now."""

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock = clock
        self._at_ns = clock.monotonic_ns() + int(seconds * 1e9)

    @property
    def passed(self) -> bool:
        """Whether it is in the past."""
        return self._clock.monotonic_ns() > self._at_ns
