"""How long exchanges take on this bus and how late this machine wakes, measured all the time; distributions
of such durations in fixed memory.

A round trip ends when the answer begins to arrive, as it begins when the frame leaves: neither its length nor
how late this machine wakes counts. The shortest recent one is what the wire, the slaves and the network card
need at least. What an exchange took beyond it was spent somewhere on its way, before the slaves looked at
their data or after.
"""

from __future__ import annotations

import math
import sys
from array import array
from collections import Counter
from itertools import repeat
from operator import rshift
from typing import Any, Final

_GAIN: Final = 1 / 64
_TURNS: Final = 7  # exchanges after which what follows from the averages is derived anew
_WINDOW_NS: Final = 2_000_000_000  # the shortest round trip is that of the last one or two of these
_FIRST_GUESS_NS: Final = 100_000.0
_FIRST_EXCESS_NS: Final = 20_000.0
_FIRST_LATE_NS: Final = 15_000.0
_LEAST_VARIANCE: Final = 1_000.0**2
_MOVED_NS: Final = 20_000.0  # change of the shortest round trip from which it is another; below, it is jitter
_OUTLIER: Final = 4.0  # standard deviations at which outliers are clipped: a stall is no jitter
_ROOM_NS: Final = 10_000.0
_PATIENCE_NS: Final = 100_000.0


class ExchangeTiming:
    """Round trips, and lateness of wake-ups, of one bus. All in ns; variances in ns²."""

    def __init__(self, now_ns: int = 0) -> None:
        self.sent_ns = now_ns  # when the last exchange was sent
        # How late the loop woke when it first slept after `took`. Not the last time: late wake-ups have it
        # learn at once, and would count for too much.
        self.woke_late_ns: float | None = None
        self.in_flight = False  # whether it is not back
        self.unanswered = 0  # exchanges that were sent since one was back
        self.unanswered_since_ns = now_ns  # when the first of them was sent, if there are several
        self.least_ns = math.inf  # the shortest recent round trip
        # By how much instants less the outward part of it are later than they were at first.
        self.moved_ns = 0.0
        self.wire_ns = 0  # what the bytes of the longest frame take on the wire
        self.late_ns = 0.0  # usual lateness of a wake-up
        self.excess_ns = _FIRST_EXCESS_NS  # what an exchange usually takes beyond the shortest
        self._excess_square = 2 * _FIRST_EXCESS_NS**2
        self._late_variance = _FIRST_LATE_NS**2
        # An exchange that is back sooner is a short one, whose arrival the slave clocks learn from.
        self.short_ns = 0.0
        # Usual time from the arrival of an answer until the program has it.
        self.taking_over_ns = 0.0
        self._least_now_ns = math.inf
        self._roll_at_ns = self._turn = 0
        self._derive()

    def _derive(self) -> None:
        # Usual delay of the slaves' look at their data by what an exchange takes beyond the shortest.
        self.look_ns = self.excess_ns / 2
        # Uniform within the excess: E[(x·e)²] = E[e²]/3.
        self.look_variance = max(self._excess_square / 3 - self.look_ns * self.look_ns, _LEAST_VARIANCE)
        # Of the difference between the instant aimed at and that of the look.
        self.variance = self.look_variance + self._late_variance
        least_ns = self.least_ns if self.least_ns < math.inf else _FIRST_GUESS_NS
        # What an exchange usually takes until its answer is there.
        self.usual_ns = least_ns + self.excess_ns + self.wire_ns
        self._most_excess_ns = _OUTLIER * math.sqrt(self._excess_square) + _ROOM_NS
        self._most_late_ns = _OUTLIER * math.sqrt(self._late_variance) + _ROOM_NS
        # After this time an answer is overdue.
        self.patience_ns = self.usual_ns + 3 * self.excess_ns + _PATIENCE_NS

    def took(self, sent_ns: int, arrived_ns: int, back_ns: int) -> None:
        """Learn from an exchange whose answer began to arrive, and was there, then; from a wake-up, too."""
        if self.woke_late_ns is not None:
            self.woke(self.woke_late_ns)
            self.woke_late_ns = None
        self.shorten(sent_ns, arrived_ns)
        excess_ns = min(arrived_ns - sent_ns - self.least_ns, self._most_excess_ns)
        self.excess_ns += _GAIN * (excess_ns - self.excess_ns)
        self._excess_square += _GAIN * (excess_ns * excess_ns - self._excess_square)
        took_over_ns = min(back_ns - arrived_ns, self.taking_over_ns + _ROOM_NS)
        self.taking_over_ns += _GAIN * (took_over_ns - self.taking_over_ns)
        self._turn -= 1
        if self._turn < 0:
            self._turn = _TURNS
            self._derive()

    def shorten(self, sent_ns: int, arrived_ns: int) -> None:
        """Learn from an exchange, which may be a short one, what the shortest is."""
        took_ns = arrived_ns - sent_ns
        before_ns = self.least_ns
        if arrived_ns >= self._roll_at_ns:
            self._roll_at_ns = arrived_ns + _WINDOW_NS
            if self._least_now_ns < math.inf:
                self.least_ns = self._least_now_ns
            self._least_now_ns = math.inf
        if took_ns < self._least_now_ns:
            self._least_now_ns = took_ns
            self.least_ns = min(self.least_ns, took_ns)
        more_ns = before_ns - self.least_ns
        if not -_MOVED_NS < more_ns < _MOVED_NS and before_ns < math.inf:
            # Round trips take what they took before: the excess is another, and where phases count from.
            more_ns = max(more_ns, -self.excess_ns)
            self._excess_square = max(self._excess_square + more_ns * (2 * self.excess_ns + more_ns), 0.0)
            self.excess_ns += more_ns
            self.moved_ns += more_ns / 2

    def woke(self, late_ns: float) -> None:
        """Learn how late the loop woke."""
        error, most = late_ns - self.late_ns, self._most_late_ns
        if not -most < error < most:
            error = math.copysign(most, error)
        self.late_ns += _GAIN * error
        self._late_variance += _GAIN * (error * error - self._late_variance)

    def look(self, sent_ns: int, arrived_ns: int) -> tuple[float, float]:
        """When the slaves looked at their data in an exchange, less the outward part of the shortest one.

        Returns the instant and its variance.
        """
        excess_ns = arrived_ns - sent_ns - self.least_ns
        if excess_ns <= 0:
            return sent_ns, 0.0
        return sent_ns + excess_ns / 2, excess_ns * excess_ns / 12

    def describe(self) -> dict[str, Any]:
        """What `status` says of it."""
        known = self.least_ns < math.inf
        return {
            "least_us": round((self.least_ns + self.wire_ns) / 1000, 1) if known else None,
            "usual_us": round(self.usual_ns / 1000, 1) if known else None,
        }


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

    `record` takes next to no time: what it takes is sorted by `count`, which is to be called now and then.
    """

    def __init__(self) -> None:
        self._ring = array("f")
        self.record = self._ring.append
        self.slots = [Distribution()]
        self.before = Distribution()  # what is older than the slots

    def count(self) -> None:
        """Sort what was recorded meanwhile."""
        self.slots[-1].count(self._ring)
        del self._ring[:]

    def roll(self) -> None:
        """A second has passed."""
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
