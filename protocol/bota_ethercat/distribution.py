# SPDX-License-Identifier: Apache-2.0
"""Distributions of durations, since the start and of the last ten seconds, in fixed memory."""

from __future__ import annotations

import sys
from array import array
from collections import Counter
from itertools import repeat
from operator import rshift
from typing import Final

_POINTS: Final = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
SLOT_NS: Final = 1_000_000_000  # a recent distribution covers the last ten slots of this length
WINDOW_SLOTS: Final = 10
# The upper bits of a float32 are its sign, its exponent and the first bits of its mantissa: of those, 5 tell
# 32 buckets an octave apart.
_UPPER_HALF: Final = slice(sys.byteorder == "little", None, 2)
_DROPPED_BITS: Final = 7 - 5
_SIGN: Final = 1 << 15 - _DROPPED_BITS


class Distribution:
    """Counts durations in ns, in buckets whose width grows with the value: exact to about 3 %.

    Only buckets that something fell into are there, about a hundred as a rule, so that reading is quick too:
    it happens between two exchanges. Negative durations count as 0.
    """

    def __init__(self) -> None:
        self.counts: Counter[int] = Counter()  # by bucket
        self._max = 0.0

    def count(self, durations: array[float]) -> None:
        """Sort durations (float32) into their buckets."""
        if durations:
            self._max = max(self._max, *durations)
            halves = array("H", durations.tobytes())[_UPPER_HALF]
            self.counts.update(map(rshift, halves, repeat(_DROPPED_BITS)))

    def add(self, other: Distribution) -> None:
        """Count everything that `other` has counted."""
        self.counts.update(other.counts)
        self._max = max(self._max, other._max)

    def summary_us(self) -> dict[str, float]:
        """p50, p99, p999 and max in microseconds, as `status` gives them; 0 without any duration."""
        points, found = iter(_POINTS.values()), list[float]()
        point, total, seen = next(points), self.counts.total(), 0
        for bucket in sorted(self.counts, key=lambda each: 0 if each & _SIGN else each):
            seen += self.counts[bucket]
            while point < 1 and seen >= point * total:
                found.append(min(_upper_edge(bucket), self._max))
                point = next(points)
        found += [self._max] * (len(_POINTS) - len(found))
        return {name: round(ns) / 1000 for name, ns in zip(_POINTS, found, strict=True)}


class RecentDistribution:
    """Distributions of everything since the start and of the last ten seconds; call `roll` once a second.

    `record` and `extend` take next to no time: `count`, to be called now and then, sorts what they took.
    """

    def __init__(self) -> None:
        self._ring = array("f")
        self.record, self.extend = self._ring.append, self._ring.extend
        self.slots = [Distribution()]
        self.before = Distribution()  # what is older than the slots

    def count(self) -> None:
        """Sort what was recorded meanwhile."""
        self.slots[-1].count(self._ring)
        del self._ring[:]

    def roll(self) -> None:
        """Begin the slot of another second; the oldest leaves the last ten."""
        self.count()
        self.slots.append(Distribution())
        if len(self.slots) > WINDOW_SLOTS:
            self.before.add(self.slots.pop(0))

    def summaries_us(self) -> tuple[dict[str, float], dict[str, float]]:
        """Summaries of all durations since the start, and of those of the last ten seconds."""
        self.count()
        total = Distribution()
        for slot in self.slots:
            total.add(slot)
        recent = total.summary_us()
        total.add(self.before)
        return total.summary_us(), recent


def _upper_edge(bucket: int) -> float:
    bits = (
        array("I", [bucket + 1 << _DROPPED_BITS + 16]) if bucket and not bucket & _SIGN else array("I", [0])
    )
    return float(memoryview(bits).cast("B").cast("f")[0])
