"""Observes the frames of one sensor for some time, for programs that keep no counts of their own."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Final

from protocol.accounting import NOT_NEW, StreamAccounting
from protocol.framing import DataMessage
from protocol.health.judge import Observation
from protocol.pdo import LAYOUTS, PdoLayout, is_finite

_COMMON: Final[PdoLayout] = LAYOUTS[min(LAYOUTS)]
_FLAGS: Final = tuple(
    _COMMON.index(name)
    for name in ("warnings", "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated")
)
_TEMPERATURE: Final = _COMMON.index("temperature")


class StreamObserver:
    """One sensor's frames from `start_ns` (CLOCK_MONOTONIC) on, subscribed to with `fresh_only` false."""

    def __init__(self, nominal_hz: float, start_ns: int, *, same_clock: bool = True) -> None:
        """`same_clock`: the server's CLOCK_MONOTONIC is that of this machine."""
        self._accounting = StreamAccounting(fresh_only=False)
        self._accounting.rate_hz = nominal_hz
        self._nominal_hz, self._same_clock = nominal_hz, same_clock
        self._start_ns = self._fresh_at_ns = start_ns
        self._silent_ns = self._not_finite = 0
        self._stamps: tuple[int, int] | None = None
        """`monotonic_ns` of the first and the newest sample."""
        self._flags = [0] * len(_FLAGS)
        self._temperature: float | None = None
        self._ages_us: list[float] = []

    def take(self, frames: Sequence[DataMessage], now_ns: int) -> None:
        """Frames that came just now, oldest first; the newest was waited for, so it has an age."""
        counts, take = self._accounting.counts, self._accounting.take
        fresh = []
        for frame in frames:
            before = counts.new
            take(frame.sequence, frame.monotonic_ns, frame.flags)
            if counts.new > before:
                fresh.append(frame)
        if not fresh:
            return
        first_ns = self._stamps[0] if self._stamps else fresh[0].monotonic_ns
        self._stamps = first_ns, fresh[-1].monotonic_ns
        self._silent_ns = max(self._silent_ns, now_ns - self._fresh_at_ns)
        self._fresh_at_ns = now_ns
        rows = [_COMMON.struct.unpack_from(frame.process_data) for frame in fresh]
        for place, index in enumerate(_FLAGS):
            self._flags[place] |= functools.reduce(operator.or_, (row[index] for row in rows))
        self._not_finite += sum(not is_finite(frame.process_data) for frame in fresh)
        self._temperature = rows[-1][_TEMPERATURE]
        if self._same_clock and not frames[-1].flags & NOT_NEW:
            self._ages_us.append((now_ns - fresh[-1].monotonic_ns) * 1e-3)

    def observation(self, now_ns: int) -> Observation:
        """All that was seen until now."""
        counts = self._accounting.counts
        warnings, force_torque, acceleration, angular_rate = self._flags
        span_ns = self._stamps[1] - self._stamps[0] if self._stamps else 0
        return Observation(
            seconds=(now_ns - self._start_ns) * 1e-9,
            samples=counts.new,
            lost=counts.missing,
            repeated=counts.repeated,
            invalid=counts.invalid,
            silent_s=max(self._silent_ns, now_ns - self._fresh_at_ns) * 1e-9,
            rate_hz=(counts.new - 1) * 1e9 / span_ns if span_ns > 0 else None,
            nominal_hz=self._nominal_hz,
            age_p99_us=p99(self._ages_us),
            not_finite=self._not_finite,
            temperature=self._temperature,
            warnings=warnings,
            force_torque_saturated=force_torque,
            acceleration_saturated=acceleration,
            angular_rate_saturated=angular_rate,
        )


def p99(values: Sequence[float]) -> float | None:
    """The value that 99 % do not exceed; None without values. A single outlier of a few is none of it."""
    return sorted(values)[(len(values) - 1) * 99 // 100] if values else None
