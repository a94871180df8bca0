"""Rate, jitter and age of one sensor's stream over the last seconds, and its counts. Every frame is used.

Kept cheap: one pass over a batch of frames, and sums only of what lies within the window.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

from clients.monitor.model.state import Spread, StreamState
from protocol.accounting import FrameKind, StreamAccounting
from protocol.framing import DataMessage

WINDOW_S: Final = 5.0
"""What rate, jitter and age look back on."""
_STALE_S: Final = 0.5


class _Batch(NamedTuple):
    """What a batch of frames adds to the window. Intervals are deviations from `StreamMeter._origin_ns`."""

    at_s: float
    samples: int
    newest_ns: int
    intervals: int
    total: int
    squares: int
    least: int
    most: int


class StreamMeter:
    """One sensor's stream."""

    def __init__(self) -> None:
        self._batches: deque[_Batch] = deque()
        self._ages: deque[tuple[float, float]] = deque()
        self._origin_ns = 0
        self._start()

    def _start(self) -> None:
        self._accounting = StreamAccounting(fresh_only=False)
        self._previous_ns: int | None = None
        self._fresh_at_s: float | None = None

    def restart(self) -> None:
        """A new connection: counts begin anew, and what lies between the two is no loss."""
        self._batches.clear()
        self._ages.clear()
        self._start()

    def take(self, frames: Sequence[DataMessage], now_s: float) -> list[bytes]:
        """The process data of the new samples among `frames`, oldest first."""
        fresh: list[bytes] = []
        intervals: list[int] = []
        previous, newest_ns = self._previous_ns, 0
        accounting = self._accounting
        counts, take = accounting.counts, accounting.take
        missing = counts.missing
        for sequence, _, monotonic_ns, _, flags, _, process_data in frames:
            if take(sequence, monotonic_ns, flags) is not FrameKind.NEW:
                previous = None
                continue
            if counts.missing == missing and previous is not None:
                intervals.append(monotonic_ns - previous)
            missing = counts.missing
            previous = newest_ns = monotonic_ns
            fresh.append(process_data)
        self._previous_ns = previous
        if fresh:
            self._fresh_at_s = now_s
            self._note(now_s, len(fresh), newest_ns, intervals)
        self._forget(now_s)
        return fresh

    def note_age(self, age_us: float, now_s: float) -> None:
        """The age of a sample in the moment it came."""
        self._ages.append((now_s, age_us))

    def state(self, now_s: float) -> StreamState:
        """The counts, and the window up to now."""
        self._forget(now_s)
        jitter, worst = self._jitter()
        counts = self._accounting.counts
        ages = sorted(age for _, age in self._ages)
        return StreamState(
            samples=counts.new,
            rate_hz=self._rate(now_s),
            jitter_us=jitter,
            jitter_worst_us=worst,
            age_us=Spread(ages[len(ages) // 2], ages[-1]) if ages else None,
            missed=counts.withheld,
            gaps=counts.gaps,
            repeated=counts.repeated,
            invalid=counts.invalid,
            silent_s=None if self._fresh_at_s is None else now_s - self._fresh_at_s,
        )

    def _note(self, now_s: float, samples: int, newest_ns: int, intervals: list[int]) -> None:
        if intervals and not self._batches:
            self._origin_ns = intervals[0]
        deviations = [interval - self._origin_ns for interval in intervals]
        self._batches.append(
            _Batch(
                now_s,
                samples,
                newest_ns,
                len(deviations),
                sum(deviations),
                sum(d * d for d in deviations),
                min(deviations, default=0),
                max(deviations, default=0),
            )
        )

    def _forget(self, now_s: float) -> None:
        for window in (self._batches, self._ages):
            while window and window[0][0] < now_s - WINDOW_S:
                window.popleft()

    def _rate(self, now_s: float) -> float | None:
        """Samples a second that came, by their stamps; by the clock here once they stop coming."""
        if self._fresh_at_s is None:
            return None
        if not self._batches:
            return 0.0
        first, last = self._batches[0], self._batches[-1]
        span_s = (last.newest_ns - first.newest_ns) * 1e-9
        if now_s - last.at_s > _STALE_S:
            span_s = now_s - first.at_s
        return (sum(b.samples for b in self._batches) - first.samples) / span_s if span_s > 0 else None

    def _jitter(self) -> tuple[float | None, float | None]:
        counted = [b for b in self._batches if b.intervals]
        count = sum(b.intervals for b in counted)
        if count < 2:
            return None, None
        mean = sum(b.total for b in counted) / count
        variance = max(0.0, sum(b.squares for b in counted) / count - mean * mean)
        worst = max(max(b.most for b in counted) - mean, mean - min(b.least for b in counted))
        return math.sqrt(variance) / 1e3, worst / 1e3
