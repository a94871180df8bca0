"""When to poll: how long after a sample is expected, so that samples are young and few exchanges are early.

An early poll costs a second exchange, or the sample where there is no time for one. docs/sample-clock.md
derives the margin.
"""

from __future__ import annotations

import math

from ethercat_server.sampling.constants import (
    EARLY_POLLS,
    LOSS_PERIODS,
    POLLS_UNLOCKED,
    QUICK_GAIN,
    RESOLUTION_NS,
    UNPROBED,
    WASTED,
)
from ethercat_server.sampling.phase import SensorPhase
from ethercat_server.sampling.round_trip import RoundTrip


class Schedule:
    """When the next exchange is wanted for one sensor.

    Attributes:
        single: whether there is no time for a second poll of a sample.
        margin_ns: how long after a sample is expected the process data should be read.
        aim_after_ns: how long after the phase the next poll should be sent.
        probing: whether that is to be early: the phase is uncertain, or was not measured for long.
    """

    def __init__(self, phase: SensorPhase, round_trip: RoundTrip) -> None:
        self._phase, self._round_trip = phase, round_trip
        self.single = True
        self.probing = False
        self._hits = 0  # samples since a poll was early
        # κ, the fraction of the margin that is needed: reads are distributed less evenly than it assumes.
        self._scale = 1.0
        self.margin_ns = 0.0
        self.aim_after_ns = 0.0

    def count_hit(self, samples: int = 1) -> None:
        """The first polls of these samples brought them."""
        self._hits += samples

    def count_polled_hit(self) -> None:
        """The first poll of a sample that polls date brought it."""
        if self._hits:
            self._scale -= QUICK_GAIN * EARLY_POLLS * self._scale

    def count_early(self, *, adapts: bool) -> None:
        """A poll was early; `adapts`: whether the margin grows by it."""
        if adapts and self._hits:
            self._scale = min(self._scale + QUICK_GAIN * self._scale, 1.0)
        self._hits = 0

    def derive(self, *, by_events: bool) -> None:
        """Derive from phase and round trips what the next poll needs."""
        phase, round_trip, variance = self._phase, self._round_trip, self._phase.variance
        self.single = round_trip.usual_ns > phase.period_ns / 2
        follows_events = by_events and not self.single
        if self.single:
            cost_ns, scale = LOSS_PERIODS * phase.period_ns, 1.0
        elif by_events:
            cost_ns, scale = WASTED * round_trip.usual_ns, 1.0
        else:
            cost_ns, scale = round_trip.usual_ns, self._scale
        margin_ns = scale * best_margin_ns(cost_ns, math.sqrt(variance + round_trip.variance))
        self.margin_ns = min(margin_ns, phase.period_ns / 2)
        probed_above = (round_trip.read_variance + RESOLUTION_NS**2) / 4
        self.probing = self._hits > UNPROBED or (variance > probed_above and not follows_events)
        self.aim_after_ns = self.margin_ns - round_trip.read_ns
        if self.probing and follows_events:
            self.aim_after_ns -= 2 * self.margin_ns

    def next_poll_ns(
        self, sent_ns: int, unanswered: int, *, in_flight: bool, locked: bool, overdue: bool
    ) -> float:
        """When the next exchange should be sent, as far as this sensor is concerned.

        The last one was sent then and may be `in_flight`; so many were not answered since one was. `overdue`:
        the sample should have come.
        """
        phase, round_trip = self._phase, self._round_trip
        aim_ns, period_ns = phase.phase_ns + self.aim_after_ns, phase.period_ns
        if not locked:
            return sent_ns + period_ns / POLLS_UNLOCKED
        if self.single:
            # The polls in flight are for the samples before: the next is for the first that has none.
            guard_ns = self.margin_ns / 2
            ahead_ns = max(0, int((sent_ns - aim_ns + guard_ns) // period_ns) + 1) * period_ns
            probe_ns = phase.phase_ns - round_trip.read_ns + ahead_ns
            if self.probing and probe_ns > sent_ns + guard_ns:
                return probe_ns
            return aim_ns + ahead_ns
        if in_flight:
            # One frame was lost, or all are: then there is no hurry.
            return max(aim_ns, sent_ns + min(unanswered * round_trip.patience_ns, period_ns))
        if sent_ns < aim_ns:
            return aim_ns
        # It was early: poll again at once, or in steps if the sample is overdue.
        return sent_ns + period_ns / (2 * POLLS_UNLOCKED) if overdue else sent_ns


def best_margin_ns(cost_ns: float, deviation_ns: float) -> float:
    """How long after the expected instant to read, so that samples are youngest on the whole.

    `cost_ns` of an early poll, as age; `deviation_ns` (standard) of the instant of the read from the
    sample's. The margin is where a little more of it costs as much as it saves: where the density of the
    read's instant is 1 / cost.
    """
    ratio = cost_ns / (deviation_ns * math.sqrt(2 * math.pi))
    return deviation_ns * math.sqrt(2 * math.log(ratio)) if ratio > 1 else 0.0
