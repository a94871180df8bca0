"""Distributions of durations in fixed memory: cheap to record, exact to about 3 %."""

from __future__ import annotations

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

    __slots__ = ("_counts", "_max", "count")

    def __init__(self) -> None:
        self._counts = [0] * (_OCTAVES * _STEPS)
        self._max = 0
        self.count = 0

    def record(self, duration_ns: int) -> None:
        """Count one duration."""
        if duration_ns > self._max:
            self._max = duration_ns
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
        self._counts = list(map(int.__add__, self._counts, other._counts))
        self._max = max(self._max, other._max)
        self.count += other.count

    def percentile_ns(self, fraction: float) -> int:
        """The duration that `fraction` (0 to 1) of all are at most; 0 if there is none."""
        wanted = fraction * self.count
        seen = 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min(_upper_edge(bucket), self._max)
        return self._max

    def summary_us(self) -> dict[str, float]:
        """p50, p99, p999 and max in microseconds, as `status` gives them."""
        points = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        summary = {name: self.percentile_ns(fraction) / 1000 for name, fraction in points.items()}
        return {**summary, "max": self._max / 1000}


class RecentDistribution:
    """A distribution of everything, and one of the last ten seconds, for the cost of one.

    `record` is that of the slot of the current second; call `roll` once a second.
    """

    __slots__ = ("_before", "_slots", "record")

    def __init__(self) -> None:
        self._before = Distribution()
        """What is older than the slots."""
        self._slots = [Distribution()]
        self.record = self._slots[-1].record

    def roll(self) -> None:
        """A second has passed."""
        self._slots.append(Distribution())
        self.record = self._slots[-1].record
        if len(self._slots) > _WINDOW_SLOTS:
            self._before.add(self._slots.pop(0))

    def everything(self) -> Distribution:
        """All durations since the start."""
        total = self.last_10s()
        total.add(self._before)
        return total

    def last_10s(self) -> Distribution:
        """Those of the last ten seconds."""
        total = Distribution()
        for slot in self._slots:
            total.add(slot)
        return total


def _upper_edge(bucket: int) -> int:
    shift = max(0, (bucket >> _STEPS_BITS) - 1)
    step = bucket - (shift << _STEPS_BITS)
    return ((step + 1) << shift) - 1
