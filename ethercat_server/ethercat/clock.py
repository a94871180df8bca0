"""Clocks and waiting; tests replace them by simulated time."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Final, Protocol

_READS: Final = 5
_FOLLOW_EVERY_NS: Final = 300_000  # in less time, reading a clock distorts its rate
SLACK_NS: Final = 1000


class Clock(Protocol):
    """CLOCK_MONOTONIC_RAW for intervals, the other two for stamps and short waits, and waiting."""

    def raw_ns(self) -> int:
        """CLOCK_MONOTONIC_RAW, ns: whoever sets this computer's time does not slew it."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""

    def time_ns(self) -> int:
        """CLOCK_REALTIME, ns."""

    def sleep(self, seconds: float, /) -> None:
        """Return after `seconds` at the earliest."""


class _SystemClock:
    """The kernel's clocks."""

    raw_ns = staticmethod(partial(time.clock_gettime_ns, time.CLOCK_MONOTONIC_RAW))
    monotonic_ns = staticmethod(time.monotonic_ns)
    time_ns = staticmethod(time.time_ns)
    sleep = staticmethod(time.sleep)


SYSTEM_CLOCK: Final[Clock] = _SystemClock()


class StampClocks:
    """CLOCK_MONOTONIC and CLOCK_REALTIME at an instant of CLOCK_MONOTONIC_RAW, against which they are slewed.

    So that nothing depends on what comes between two reads, a clock is read between two reads of another.

    Attributes:
        rate, base_ns: CLOCK_MONOTONIC is CLOCK_MONOTONIC_RAW times `rate`, and `base_ns`, since `follow`.
        realtime_ns: CLOCK_REALTIME less CLOCK_MONOTONIC. It is constant until CLOCK_REALTIME is set: the
            kernel slews both alike.
    """

    def __init__(self, clock: Clock) -> None:
        self._raw_ns, self._monotonic_ns, self._time_ns = clock.raw_ns, clock.monotonic_ns, clock.time_ns
        self.rate = 1.0
        self._at_ns = clock.raw_ns()
        self.base_ns: float = _difference(self._monotonic_ns, self._raw_ns)
        self.realtime_ns = _difference(self._time_ns, self._monotonic_ns)

    def follow_realtime(self) -> None:
        """To be called regularly: notices that CLOCK_REALTIME was set."""
        least, most = _bounds(self._time_ns, self._monotonic_ns)
        if not least <= self.realtime_ns <= most:
            self.realtime_ns = _difference(self._time_ns, self._monotonic_ns)

    def follow(self) -> None:
        """To be called before an instant is converted, at least where `SLACK_NS` are exceeded."""
        before_ns, monotonic_ns, after_ns = self._raw_ns(), self._monotonic_ns(), self._raw_ns()
        if (passed_ns := before_ns - self._at_ns) > _FOLLOW_EVERY_NS:
            expected_ns = before_ns * self.rate + self.base_ns
            now_ns = min(max(expected_ns, monotonic_ns - (after_ns - before_ns)), monotonic_ns)
            self.rate += (now_ns - expected_ns) / passed_ns
            self.base_ns, self._at_ns = now_ns - before_ns * self.rate, before_ns

    def monotonic_ns(self, raw_ns: float) -> int:
        """CLOCK_MONOTONIC at an instant near now."""
        self.follow()
        return int(raw_ns * self.rate + self.base_ns)


def _bounds(clock_ns: Callable[[], int], other_ns: Callable[[], int]) -> tuple[int, int]:
    """How far a clock is ahead of another, at least and at most."""
    before_ns, time_ns, after_ns = other_ns(), clock_ns(), other_ns()
    return time_ns - after_ns, time_ns - before_ns


def _difference(clock_ns: Callable[[], int], other_ns: Callable[[], int]) -> int:
    """How far a clock is ahead of another."""
    bounds = (_bounds(clock_ns, other_ns) for _ in range(_READS))
    least, most = min(bounds, key=lambda each: each[1] - each[0])
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
