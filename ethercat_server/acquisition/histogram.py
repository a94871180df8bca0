"""Distributions of durations in fixed memory: next to nothing to record, exact to about 3 %."""

from __future__ import annotations

import sys
from array import array
from collections import Counter
from collections.abc import Sequence
from itertools import repeat
from operator import rshift
from typing import Final

_POINTS: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
_WINDOW_SLOTS: Final = 10
# A recent distribution covers the last ten slots of this length.
SLOT_NS: Final = 1_000_000_000
# The upper bits of a float32 are its sign, its exponent and the first bits of its mantissa: of those, 5 tell
# 32 buckets an octave apart.
_UPPER_HALF: Final = slice(sys.byteorder == "little", None, 2)
_DROPPED_BITS: Final = 7 - 5
_SIGN: Final = 1 << 15 - _DROPPED_BITS


class Distribution:
    """Counts durations in buckets whose width grows with the value: 32 buckets an octave.

    Only buckets that something fell into are there, about a hundred as a rule, so that reading is quick too:
    it happens between two exchanges. Durations are nanoseconds; negative ones count as 0.
    """

    __slots__ = ("_counts", "_max", "_ring", "record")

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._max = 0.0
        # What was recorded since `count`: sorting it into buckets can wait.
        self._ring = array("f")
        self.record = self._ring.append

    def count(self) -> int:
        """Sort what was recorded into its buckets; the number of all durations so far."""
        if ring := self._ring:
            self._max = max(self._max, *ring)
            halves = array("H", ring.tobytes())[_UPPER_HALF]
            self._counts.update(map(rshift, halves, repeat(_DROPPED_BITS)))
            del ring[:]
        return self._counts.total()

    def add(self, other: Distribution) -> None:
        """Count everything that `other` has counted."""
        other.count()
        self._counts.update(other._counts)
        self._max = max(self._max, other._max)

    def percentiles_ns(self, fractions: Sequence[float]) -> list[float]:
        """The durations that these parts (0 to 1, ascending) of all are at most; 0 if there is none."""
        total, found, seen = self.count(), list[float](), 0
        for bucket in [each for each in self._counts if each & _SIGN]:
            self._counts[0] += self._counts.pop(bucket)
        for bucket in sorted(self._counts):
            seen += self._counts[bucket]
            while len(found) < len(fractions) and seen >= fractions[len(found)] * total:
                found.append(min(_upper_edge(bucket), self._max))
        return found + [self._max] * (len(fractions) - len(found))

    def summary_us(self) -> dict[str, float]:
        """p50, p99, p999 and max in microseconds, as `status` gives them."""
        found = [*self.percentiles_ns(tuple(_POINTS.values())), self._max]
        return {name: round(ns) / 1000 for name, ns in zip((*_POINTS, "max"), found, strict=True)}


class RecentDistribution:
    """A distribution of everything, and one of the last ten seconds, for the cost of one.

    `record` is that of the slot of the current second; call `roll` once a second.
    """

    __slots__ = ("_before", "_slots", "record")

    def __init__(self) -> None:
        self._before = Distribution()  # what is older than the slots
        self._slots = [Distribution()]
        self.record = self._slots[-1].record

    def count(self) -> None:
        """To be called now and then: what was recorded meanwhile is sorted."""
        self._slots[-1].count()

    def roll(self) -> None:
        """A second has passed."""
        self.count()
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


def _upper_edge(bucket: int) -> float:
    bits = array("I", [bucket + 1 << _DROPPED_BITS + 16]) if bucket else array("I", [0])
    return float(memoryview(bits).cast("B").cast("f")[0])
