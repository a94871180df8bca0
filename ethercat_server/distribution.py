"""Distributions of durations in fixed memory: cheap to record, exact to about 3 %."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from itertools import accumulate
from operator import add, sub
from typing import Final

_STEPS_BITS: Final = 5
_STEPS: Final = 1 << _STEPS_BITS
_OCTAVES: Final = 36
_WINDOW_SLOTS: Final = 10
SLOT_NS: Final = 1_000_000_000
"""A recent distribution covers the last ten slots of this length."""


class Distribution:
    """Counts durations in buckets whose width grows with the value: 32 buckets an octave.

    Recording is one list increment. Durations are whole nanoseconds; negative ones count as 0.
    """

    __slots__ = ("_counts", "count", "max")

    def __init__(self) -> None:
        self._counts = [0] * (_OCTAVES * _STEPS)
        self.max = 0
        self.count = 0

    def record(self, duration_ns: int) -> None:
        """Count one duration."""
        if duration_ns > self.max:
            self.max = duration_ns
        elif duration_ns < 0:
            duration_ns = 0
        self.count += 1
        shift = duration_ns.bit_length() - _STEPS_BITS - 1
        if shift <= 0:
            self._counts[duration_ns] += 1
        else:
            # The leading bit is implied: what is left of the top six bits numbers the step.
            self._counts[min((shift << _STEPS_BITS) + (duration_ns >> shift), len(self._counts) - 1)] += 1

    def add(self, other: Distribution) -> None:
        """Count everything that `other` has counted."""
        self._counts = list(map(add, self._counts, other._counts))
        self.max = max(self.max, other.max)
        self.count += other.count

    def take_away(self, other: Distribution, new_max: int) -> None:
        """Forget what `other` has counted, which was added before; the maximum is `new_max` then."""
        self._counts = list(map(sub, self._counts, other._counts))
        self.max = new_max
        self.count -= other.count

    def percentiles_ns(self, *fractions: float) -> list[int]:
        """The durations that these parts (0 to 1) of all are at most; 0 if there is none."""
        seen = list(accumulate(self._counts))
        buckets = (bisect_left(seen, max(fraction * self.count, 1)) for fraction in fractions)
        return [min(_upper_edge(bucket), self.max) if self.count else self.max for bucket in buckets]

    def summary_us(self) -> dict[str, float]:
        """p50, p99, p999 and max in microseconds, as `status` gives them."""
        p50, p99, p999 = self.percentiles_ns(0.5, 0.99, 0.999)
        return {"p50": p50 / 1000, "p99": p99 / 1000, "p999": p999 / 1000, "max": self.max / 1000}


class RecentDistribution:
    """A distribution of everything, and one of the last ten seconds, for the cost of one.

    `record` is that of the slot of the current second; call `roll` once a second.
    """

    __slots__ = ("_before", "_finished", "_now", "_recent", "record")

    def __init__(self) -> None:
        self._before = Distribution()
        """What is older than the last ten slots."""
        self._finished: deque[Distribution] = deque()
        """The slots of the last ten seconds but for the one now."""
        self._recent = Distribution()
        """Their sum, kept so that `status` need not add them up between two exchanges."""
        self._now = Distribution()
        self.record = self._now.record

    def roll(self) -> None:
        """A second has passed."""
        self._finished.append(self._now)
        self._recent.add(self._now)
        self._now = Distribution()
        self.record = self._now.record
        if len(self._finished) == _WINDOW_SLOTS:
            oldest = self._finished.popleft()
            self._before.add(oldest)
            self._recent.take_away(oldest, max(slot.max for slot in self._finished))

    def everything(self) -> Distribution:
        """All durations since the start."""
        total = self.last_10s()
        total.add(self._before)
        return total

    def last_10s(self) -> Distribution:
        """Those of the last ten seconds."""
        total = Distribution()
        total.add(self._recent)
        total.add(self._now)
        return total


def _upper_edge(bucket: int) -> int:
    shift = max(0, (bucket >> _STEPS_BITS) - 1)
    step = bucket - (shift << _STEPS_BITS)
    return ((step + 1) << shift) - 1
