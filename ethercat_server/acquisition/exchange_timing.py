"""How long exchanges take on this bus and how late this machine wakes, measured all the time.

A round trip ends when the answer begins to arrive, as it begins when the frame leaves: neither its length nor
how late this machine wakes counts. The shortest recent one is what the wire, the slaves and the network card
need at least. What an exchange took beyond it was spent somewhere on its way, before the slaves looked at
their data or after.
"""

from __future__ import annotations

import math
from typing import Any, Final

_GAIN: Final = 1 / 64
# What follows from the averages is derived anew every so many exchanges.
_TURNS: Final = 7
# The shortest round trip is that of the last one or two of these.
_WINDOW_NS: Final = 2_000_000_000
_FIRST_GUESS_NS: Final = 100_000.0
_FIRST_EXCESS_NS: Final = 20_000.0
_FIRST_LATE_NS: Final = 15_000.0
_LEAST_VARIANCE: Final = 1_000.0**2
# The shortest round trip has become another if it changes by this; below, it is jitter.
_MOVED_NS: Final = 20_000.0
# What lies further out than so many standard deviations counts as that far: a stall is no jitter.
_OUTLIER: Final = 4.0
_ROOM_NS: Final = 10_000.0
_PATIENCE_NS: Final = 100_000.0


class ExchangeTiming:
    """Round trips, and lateness of wake-ups, of one bus. All in ns; variances in ns²."""

    __slots__ = (
        "_excess_square", "_late_variance", "_least_now_ns", "_most_excess_ns", "_most_late_ns",
        "_roll_at_ns", "_turn", "excess_ns", "in_flight", "late_ns", "least_ns", "look_ns", "look_variance",
        "moved_ns", "patience_ns", "sent_ns", "short_ns", "taking_over_ns", "unanswered",
        "unanswered_since_ns", "usual_ns", "variance", "wire_ns", "woke_late_ns",
    )  # fmt: skip

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
        # An exchange that is back sooner is a short one, of which somebody wants to know when it arrived.
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
        """The loop woke so long after it had wanted to."""
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
