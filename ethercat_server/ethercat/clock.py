"""Clocks and waiting; tests replace them by simulated time."""

from __future__ import annotations

import fcntl
import struct
import time
from typing import Final, Protocol

_READS: Final = 5
_SIOCGSTAMPNS: Final = 0x80108907
_TIMESPEC: Final = struct.Struct("=qq")


class Clock(Protocol):
    """CLOCK_MONOTONIC for intervals, CLOCK_REALTIME for stamps, and waiting."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""

    def time_ns(self) -> int:
        """CLOCK_REALTIME, ns."""

    def sleep(self, seconds: float, /) -> None:
        """Return after `seconds` at the earliest."""


class SystemClock:
    """The kernel's clocks."""

    monotonic_ns = staticmethod(time.monotonic_ns)
    time_ns = staticmethod(time.time_ns)
    sleep = staticmethod(time.sleep)


SYSTEM_CLOCK: Final = SystemClock()


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


def arrived_ns(fd: int) -> int:
    """CLOCK_MONOTONIC when the packet that was received last from the socket `fd` had arrived.

    0 if the kernel does not say, as at the first call, which has it stamp packets. The stamp is in
    CLOCK_REALTIME: it is wrong if that was set in between.
    """
    try:
        seconds, ns = _TIMESPEC.unpack(fcntl.ioctl(fd, _SIOCGSTAMPNS, bytes(_TIMESPEC.size)))
    except OSError:
        return 0
    waited_ns = time.time_ns() - int(seconds * 1_000_000_000 + ns)
    return time.monotonic_ns() - waited_ns  # if anything comes between the two clocks, it is too late
