"""How long exchanges take on a bus and how late this machine wakes, measured all the time.

A round trip ends when the answer begins to arrive, as it begins when the frame leaves: neither its length nor
how late this machine wakes counts. The shortest recent one is what the wire, the slaves and the network card
need at least. What an exchange took beyond it was spent somewhere on its way, before the slaves read their
process data or after.
"""

from __future__ import annotations

import math
from typing import Any

from ethercat_server.sampling.constants import (
    CONTRADICTS,
    GAIN,
    MACHINE_JITTER_NS,
    PATIENCE_NS,
    RESOLUTION_NS,
    WINDOW_NS,
)


class RoundTrip:
    """Round trips, and lateness of wake-ups, of one bus.

    Attributes:
        least_ns: the shortest recent round trip.
        excess_ns: what an exchange usually takes beyond the shortest.
        usual_ns: what it usually takes until its answer is there.
        patience_ns: after this time an answer is overdue.
        taking_over_ns: usual time from the arrival of an answer until the program has it.
        read_ns: usual delay of the slaves' PDI read by what an exchange takes beyond the shortest.
        read_variance: of that.
        late_ns: usual lateness of a wake-up.
        variance: of the difference between the instant aimed at and that of the PDI read.
        moved_ns: total shift of all instants less the outward part of the shortest round trip, which is their
            origin, since the start.
    """

    def __init__(self, wire_ns: int = 0) -> None:
        """`wire_ns`: what the bytes of the longest frame take on the wire."""
        self._wire_ns = wire_ns
        self.least_ns = math.inf
        self.moved_ns = 0.0
        self.late_ns = 0.0
        self.excess_ns = MACHINE_JITTER_NS
        self._excess_square = 2 * MACHINE_JITTER_NS**2
        self._late_variance = MACHINE_JITTER_NS**2
        self.taking_over_ns = 0.0
        self._least_now_ns = math.inf
        self._roll_at_ns = 0
        self._derive()

    def _derive(self) -> None:
        self.read_ns = self.excess_ns / 2
        # Uniform within the excess: E[(x·e)²] = E[e²]/3.
        self.read_variance = max(self._excess_square / 3 - self.read_ns * self.read_ns, RESOLUTION_NS**2)
        self.variance = self.read_variance + self._late_variance
        least_ns = self.least_ns if self.least_ns < math.inf else PATIENCE_NS
        self.usual_ns = least_ns + self.excess_ns + self._wire_ns
        self.patience_ns = self.usual_ns + CONTRADICTS * self.excess_ns + PATIENCE_NS

    def learn(self, sent_ns: int, arrived_ns: int, back_ns: int, late_ns: float | None = None) -> None:
        """Learn from an exchange whose answer began to arrive, and was there, then.

        `late_ns`: how late the loop woke when it first slept after the one before, if it did. Not the last
        time: late wake-ups have it learn at once, and would count for too much.
        """
        if late_ns is not None:
            self._learn_wake_up(late_ns)
        self.learn_shortest(sent_ns, arrived_ns)
        most_ns = CONTRADICTS * math.sqrt(self._excess_square) + MACHINE_JITTER_NS  # a stall is no jitter
        excess_ns = min(arrived_ns - sent_ns - self.least_ns, most_ns)
        self.excess_ns += GAIN * (excess_ns - self.excess_ns)
        self._excess_square += GAIN * (excess_ns * excess_ns - self._excess_square)
        took_over_ns = min(back_ns - arrived_ns, self.taking_over_ns + MACHINE_JITTER_NS)
        self.taking_over_ns += GAIN * (took_over_ns - self.taking_over_ns)
        self._derive()

    def learn_shortest(self, sent_ns: int, arrived_ns: int) -> None:
        """Learn the shortest round trip, also from an exchange that nothing else is learned from."""
        took_ns = arrived_ns - sent_ns
        before_ns = self.least_ns
        if arrived_ns >= self._roll_at_ns:
            self._roll_at_ns = arrived_ns + WINDOW_NS
            if self._least_now_ns < math.inf:
                self.least_ns = self._least_now_ns
            self._least_now_ns = math.inf
        if took_ns < self._least_now_ns:
            self._least_now_ns = took_ns
            self.least_ns = min(self.least_ns, took_ns)
        more_ns = before_ns - self.least_ns
        if not -MACHINE_JITTER_NS < more_ns < MACHINE_JITTER_NS and before_ns < math.inf:
            # The same round trips have another excess over the shortest, and phases another origin.
            more_ns = max(more_ns, -self.excess_ns)
            self._excess_square = max(self._excess_square + more_ns * (2 * self.excess_ns + more_ns), 0.0)
            self.excess_ns += more_ns
            self.moved_ns += more_ns / 2

    def _learn_wake_up(self, late_ns: float) -> None:
        most_ns = CONTRADICTS * math.sqrt(self._late_variance) + MACHINE_JITTER_NS
        error = max(-most_ns, min(late_ns - self.late_ns, most_ns))
        self.late_ns += GAIN * error
        self._late_variance += GAIN * (error * error - self._late_variance)

    def read_instant(self, sent_ns: int, arrived_ns: int) -> tuple[float, float]:
        """When the slaves read their data in an exchange, less the outward part of the shortest one.

        Returns the instant and its variance.
        """
        excess_ns = arrived_ns - sent_ns - self.least_ns
        if excess_ns <= 0:
            return sent_ns, 0.0
        return sent_ns + excess_ns / 2, excess_ns * excess_ns / 12

    def as_json(self) -> dict[str, Any]:
        """The object `round_trip` of `status`."""
        known = self.least_ns < math.inf
        return {
            "least_us": round((self.least_ns + self._wire_ns) / 1000, 1) if known else None,
            "usual_us": round(self.usual_ns / 1000, 1) if known else None,
        }
