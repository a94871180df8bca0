"""Observes the frames of one sensor over a time that ends now. Every frame is used."""

from __future__ import annotations

import functools
import operator
from collections import deque
from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

from protocol.accounting import NOT_NEW, StreamAccounting, StreamCounts
from protocol.framing import DataMessage
from protocol.health.judge import Observation
from protocol.pdo import LAYOUTS, PdoLayout, is_finite

_COMMON: Final[PdoLayout] = LAYOUTS[min(LAYOUTS)]
_FLAGS: Final = tuple(
    _COMMON.index(name)
    for name in ("warnings", "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated")
)
_NO_FLAGS: Final = (0,) * len(_FLAGS)
_TEMPERATURE: Final = _COMMON.index("temperature")
_MOST_AGES: Final = 1 << 16
_HIGHEST_HZ: Final = 1e6
"""A rate beyond it is no sensor's, and not known."""


class _Batch(NamedTuple):
    """What came at one moment."""

    at_ns: int
    counts: tuple[int, int, int, int]
    """Samples, and those missing; frames repeated and invalid."""
    silent_ns: int
    """How long before there had been no sample; 0 if it brings none."""
    stamps: tuple[int, int] | None
    """`monotonic_ns` of the first and the last sample."""
    flags: tuple[int, ...]
    not_finite: int

    def then(self, later: _Batch) -> _Batch:
        """Both, as one."""
        n, m, r, i = (a + b for a, b in zip(self.counts, later.counts, strict=True))
        stamps = [batch.stamps for batch in (self, later) if batch.stamps is not None]
        return _Batch(
            later.at_ns,
            (n, m, r, i),
            max(self.silent_ns, later.silent_ns),
            (stamps[0][0], stamps[-1][1]) if stamps else None,
            tuple(a | b for a, b in zip(self.flags, later.flags, strict=True)),
            self.not_finite + later.not_finite,
        )


class StreamObserver:
    """One sensor's frames from `start_ns` (CLOCK_MONOTONIC) on, subscribed to with `fresh_only` false."""

    def __init__(self, nominal_hz: float, start_ns: int, *, window_ns: int | None = None) -> None:
        """`window_ns`: look back no further than this."""
        self._accounting = StreamAccounting(fresh_only=False)
        self._nominal_hz = nominal_hz if 0 < nominal_hz <= _HIGHEST_HZ else 0.0
        self._accounting.rate_hz = self._nominal_hz
        self._window_ns = window_ns
        self._start_ns = self._fresh_at_ns = start_ns
        self._batches: deque[_Batch] = deque()
        self._ages: deque[tuple[int, float]] = deque(maxlen=_MOST_AGES)
        self._temperature: float | None = None

    def take(self, frames: Sequence[DataMessage], now_ns: int) -> None:
        """Frames that came just now, oldest first."""
        if not frames:
            return
        before = _figures(self._accounting.counts)
        fresh = []
        for frame in frames:
            new = self._accounting.counts.new
            self._accounting.take(frame.sequence, frame.monotonic_ns, frame.flags)
            if self._accounting.counts.new > new:
                fresh.append(frame)
        grown = [now - then for now, then in zip(_figures(self._accounting.counts), before, strict=True)]
        counts = (grown[0], grown[1], grown[2], grown[3])
        if not fresh:
            self._append(_Batch(now_ns, counts, 0, None, _NO_FLAGS, 0))
            return
        rows = [_COMMON.struct.unpack_from(frame.process_data) for frame in fresh]
        self._temperature = rows[-1][_TEMPERATURE]
        flags = tuple(functools.reduce(operator.or_, (row[index] for row in rows)) for index in _FLAGS)
        not_finite = sum(not is_finite(frame.process_data) for frame in fresh)
        stamps = fresh[0].monotonic_ns, fresh[-1].monotonic_ns
        silent_ns, self._fresh_at_ns = now_ns - self._fresh_at_ns, now_ns
        self._append(_Batch(now_ns, counts, silent_ns, stamps, flags, not_finite))

    def forget(self) -> None:
        """Forget all that has been."""
        self._batches.clear()
        self._ages.clear()

    def note_age(self, frame: DataMessage, now_ns: int) -> None:
        """This frame was waited for and came just now, on the server's own machine."""
        if not frame.flags & NOT_NEW:
            self._ages.append((now_ns, (now_ns - frame.monotonic_ns) * 1e-3))

    def observation(self, now_ns: int) -> Observation:
        """What was seen until now."""
        self._forget(now_ns)
        seconds = (now_ns - self._start_ns) * 1e-9
        if self._window_ns is not None:
            seconds = min(seconds, self._window_ns * 1e-9)
        nothing = _Batch(now_ns, (0, 0, 0, 0), 0, None, _NO_FLAGS, 0)
        seen = functools.reduce(_Batch.then, self._batches, nothing)
        samples, lost, repeated, invalid = seen.counts
        warnings, force_torque, acceleration, angular_rate = seen.flags
        span_ns = seen.stamps[1] - seen.stamps[0] if seen.stamps else 0
        return Observation(
            seconds=seconds,
            samples=samples,
            lost=lost,
            repeated=repeated,
            invalid=invalid,
            silent_s=max(seen.silent_ns, now_ns - self._fresh_at_ns) * 1e-9,
            rate_hz=(samples - 1) * 1e9 / span_ns if span_ns > 0 else None,
            nominal_hz=self._nominal_hz,
            age_p99_us=p99([age_us for _, age_us in self._ages]),
            not_finite=seen.not_finite,
            temperature=self._temperature,
            warnings=warnings,
            force_torque_saturated=force_torque,
            acceleration_saturated=acceleration,
            angular_rate_saturated=angular_rate,
        )

    def _append(self, batch: _Batch) -> None:
        if self._window_ns is None and self._batches:
            batch = self._batches.pop().then(batch)
        self._batches.append(batch)
        self._forget(batch.at_ns)

    def _forget(self, now_ns: int) -> None:
        if self._window_ns is None:
            return
        while self._batches and self._batches[0].at_ns < now_ns - self._window_ns:
            self._batches.popleft()
        while self._ages and self._ages[0][0] < now_ns - self._window_ns:
            self._ages.popleft()


def _figures(counts: StreamCounts) -> tuple[int, int, int, int]:
    return counts.new, counts.missing, counts.repeated, counts.invalid


def p99(values: Collection[float]) -> float | None:
    """The value that 99 % do not exceed; None without values. A single outlier of a few is none of it."""
    return sorted(values)[(len(values) - 1) * 99 // 100] if values else None
