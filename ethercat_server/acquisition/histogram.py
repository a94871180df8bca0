"""Distributions of durations in fixed memory: cheap to record, exact to about 3 %."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Final

_STEPS_BITS: Final = 5
_STEPS: Final = 1 << _STEPS_BITS
_OCTAVES: Final = 36
_LAST_BUCKET: Final = _OCTAVES * _STEPS - 1
_POINTS: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
_WINDOW_SLOTS: Final = 10
SLOT_NS: Final = 1_000_000_000
"""A recent distribution covers the last ten slots of this length."""


class Distribution:
    """Counts durations in buckets whose width grows with the value: 32 buckets an octave.

    Only buckets that something fell into are there, about a hundred as a rule, so that reading is quick too:
    it happens between two exchanges. Durations are whole nanoseconds; negative ones count as 0.
    """

    __slots__ = ("_counts", "_max", "count")

    def __init__(self) -> None:
        self._counts: defaultdict[int, int] = defaultdict(int)
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
            bucket = (shift << _STEPS_BITS) + (duration_ns >> shift)
            self._counts[bucket if bucket < _LAST_BUCKET else _LAST_BUCKET] += 1

    def add(self, other: Distribution) -> None:
        """Count everything that `other` has counted."""
        counts = self._counts
        for bucket, count in other._counts.items():
            counts[bucket] += count
        self._max = max(self._max, other._max)
        self.count += other.count

    def percentiles_ns(self, fractions: Sequence[float]) -> list[int]:
        """The durations that these parts (0 to 1, ascending) of all are at most; 0 if there is none."""
        found: list[int] = []
        seen = 0
        for bucket in sorted(self._counts):
            seen += self._counts[bucket]
            while len(found) < len(fractions) and seen >= fractions[len(found)] * self.count:
                found.append(min(_upper_edge(bucket), self._max))
        return found + [self._max] * (len(fractions) - len(found))

    def summary_us(self) -> dict[str, float]:
        """p50, p99, p999 and max in microseconds, as `status` gives them."""
        found = self.percentiles_ns(tuple(_POINTS.values()))
        summary = {name: value / 1000 for name, value in zip(_POINTS, found, strict=True)}
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

    def summaries_us(self) -> tuple[dict[str, float], dict[str, float]]:
        """Summaries of all durations since the start, and of those of the last ten seconds."""
        total = Distribution()
        for slot in self._slots:
            total.add(slot)
        recent = total.summary_us()
        total.add(self._before)
        return total.summary_us(), recent


def _upper_edge(bucket: int) -> int:
    shift = max(0, (bucket >> _STEPS_BITS) - 1)
    step = bucket - (shift << _STEPS_BITS)
    return ((step + 1) << shift) - 1
