"""Follows a sensor's own sampling clock, so that a poll falls right after each sample came to be.

The sensor samples freely; an exchange only tells whether its process data changed since the one before. From
that `Estimate` says when the next sample comes to be. What is not known well, because a frame was lost or the
machine stood still, leaves it as it is: it holds over, and its uncertainty grows as crystals wander.
"""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.acquisition.hardware.event_times import EventTimes
from ethercat_server.acquisition.timing.estimate import CERTAIN, CONTRADICTS, Estimate
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.timing.margin import has_no_time_for_two, margin_ns

_LOCKED: Final = 0.125
"""The clock is followed while the phase is known to this part of a period (standard deviation)."""
_POLLS_UNLOCKED: Final = 4
"""Exchanges a sample while it is not."""
_SEARCH_STEPS: Final = 8
"""Exchanges a sample once one is overdue."""
_OVERDUE: Final = 2.0
"""It is, so many standard deviations after it was expected."""
PLAUSIBLE_PULL: Final = 0.002
"""A real sensor's period differs from the nominal one by less than this part."""
SILENT_PERIODS: Final = 3
"""A sensor that has given nothing new for so long counts as silent, not just late."""
_EARLY_POLLS: Final = 0.11
"""Part of the samples whose first poll is to be early."""
_CAUTION_GAIN: Final = 0.05
_TURNS: Final = 7
_CHANGED: Final = 1.25
"""The margin is derived anew every so many exchanges, and when the variance has changed by this factor."""
_PROBE_BELOW: Final = 5_000.0**2
"""A phase known so well needs no probes, however well polls could tell it."""
_UNPROBED: Final = 500
"""After so many samples without an early look it is tried whether the phase is still what it was."""
_LONGEST_LOOK: Final = 0.5
"""The sensor looks at its data within this part of a period after the frame usually has reached it."""
_EARLY: Final = -0.25
"""A sample so much before the expected one, in periods, is the one that was watched for before."""
_BIAS_GAIN: Final = 1 / 64
_ONE_ONLY, _MISSABLE = 0.8, 1.25
"""Only one sample can have come in this part of a period; more may have in this."""


class SampleClock:
    """The sampling clock of one sensor, as far as the exchanges have shown it. Times are CLOCK_MONOTONIC ns.

    Call `observe` after every valid exchange, before it `predict` if that brought a new sample; ask
    `next_poll_ns` when the next exchange is wanted. Exchanges come in the order in which they were sent. They
    are back when this program has them, and arrive when their first byte does.
    """

    __slots__ = (
        "_absent", "_aim_ns", "_begun", "_bias_ns", "_by_event", "_caution", "_doubtful", "_hits",
        "_least_variance", "_looked_ns", "_margin_ns", "_most_variance", "_moved_ns", "_newest", "_overdue",
        "_passing_ns", "_probed_above", "_probing", "_seen_by_ns", "_single", "_timing", "_turn",
        "_usual_margin_ns",
        "estimate", "events", "instant_ns", "locked", "quiet_until_ns", "steps", "uncertain",
    )  # fmt: skip

    def __init__(
        self,
        period_ns: float,
        timing: ExchangeTiming,
        events: EventTimes | None = None,
        passing_ns: int = 0,
    ) -> None:
        """`period_ns` is the nominal sample period; `timing` that of the bus.

        The process data passes the slave `passing_ns` after the frame has arrived there.
        """
        self.events = events
        self.estimate = Estimate(period_ns)
        """Its phase is the next sample's instant less the outward part of the shortest round trip."""
        self._passing_ns = passing_ns
        self._timing = timing
        self.locked = False
        self.instant_ns = 0.0
        """Estimated instant of the newest sample, from those before it."""
        self.steps = 1
        """How many samples the newest one is after the one handed out before it: more than 1, some were
        lost; 0, one was counted as lost that was not."""
        self.uncertain = False
        """Whether more may have been lost than `steps` says. The samples after it tell, and their `steps` put
        it right."""
        self.quiet_until_ns = 0.0
        """An exchange that is back before this has certainly nothing new."""
        self._by_event = 0.0
        """Instant of the newest sample as its event has it, less the outward part; 0: it says nothing."""
        self._looked_ns = 0
        """When the last valid exchange was sent."""
        self._moved_ns = timing.moved_ns
        self._bias_ns = 0.0
        """By how much events are later than polls show, where both are followed."""
        self._newest = 1
        """Number of the newest sample, counted from the one before it by the phase alone."""
        self._seen_by_ns = 0.0
        """When the sensor had certainly looked in the exchange that brought the newest sample."""
        self._absent = 0
        """Samples in a row that were watched for and did not come."""
        self._begun = False
        """Whether a sample was seen coming."""
        self._doubtful = False
        """Whether the sample before was `uncertain`."""
        self._overdue = False
        self._single = True
        """Whether there is no time for a second poll of a sample."""
        self._probing = False
        """Whether the phase is known worse than polls can tell it, or has not been tried for long."""
        self._hits = 0
        """Samples since a look was early."""
        self._caution = 1.0
        """Part of the margin that is needed: looks are spread less evenly than a margin assumes."""
        self._turn = 0
        self._least_variance = self._most_variance = 0.0
        """Between these the margin is as it was derived last."""
        self._usual_margin_ns = self._margin_ns = self._probed_above = 0.0
        self._aim_ns = 0.0
        """When the next poll should be sent."""
        self._settle()

    @property
    def period_ns(self) -> float:
        """Estimated period."""
        return self.estimate.period_ns

    @property
    def uncertainty_ns(self) -> float:
        """How far `instant_ns` may be off: two standard deviations, and where the slave is on the way.

        What a round trip usually takes beyond the shortest may be on one side of it, which none can tell. A
        sample that may be another one than thought may be off by a period.
        """
        events, timing = self.events, self._timing
        if events is not None and events.are_trusted:
            variance, way_ns = events.variance, events.way_ns
        else:
            variance, way_ns = self.estimate.variance, timing.least_ns + timing.excess_ns
        return 2 * math.sqrt(variance) + way_ns / 2 + (self.estimate.period_ns if self.uncertain else 0.0)

    @property
    def by_events(self) -> bool:
        """Whether samples are dated by the slave controller."""
        return self.events is not None and self.events.are_trusted

    @property
    def _follows_events(self) -> bool:
        """Whether phase and period are learned from events.

        Where an early poll costs a sample, only polls tell when to poll: event times may be off by more than
        polls stand, and agree with polling as far as the long round trip tells.
        """
        return self.by_events and not self._single

    @property
    def one_by_one(self) -> bool:
        """Whether it is followed, and an exchange is back before the next one is wanted."""
        return self.locked and not self._single

    # -- when to poll

    def next_poll_ns(self) -> float:
        """When the next exchange should be sent, as far as this sensor is concerned."""
        timing, aim_ns, period_ns = self._timing, self._aim_ns, self.estimate.period_ns
        sent_ns = timing.sent_ns
        if not self.locked:
            return sent_ns + period_ns / _POLLS_UNLOCKED
        if self._single:
            # The polls that are on their way are for the samples before: the first that has none is next.
            guard_ns = self._margin_ns / 2
            ahead_ns = max(0, int((sent_ns - aim_ns + guard_ns) // period_ns) + 1) * period_ns
            probe_ns = self.estimate.phase_ns - timing.look_ns + ahead_ns
            if self._probing and probe_ns > sent_ns + guard_ns:
                return probe_ns
            return aim_ns + ahead_ns
        if timing.in_flight:
            # One frame was lost, or all are: then there is no hurry.
            return max(aim_ns, sent_ns + min(timing.unanswered * timing.patience_ns, period_ns))
        if sent_ns < aim_ns:
            return aim_ns
        # It was early: again, at once, or in steps if the sample is overdue.
        return sent_ns + period_ns / _SEARCH_STEPS if self._overdue else sent_ns

    def _settle(self) -> None:
        """Derive from the estimate what the next poll needs."""
        timing, estimate = self._timing, self.estimate
        variance, period_ns = estimate.variance, estimate.period_ns
        deviation_ns = math.sqrt(variance)
        self.locked = self._begun and deviation_ns < _LOCKED * period_ns
        self._turn -= 1
        if self._turn < 0 or not self._least_variance < variance < self._most_variance:
            self._turn = _TURNS
            self._least_variance, self._most_variance = variance / _CHANGED, variance * _CHANGED
            self._single = has_no_time_for_two(timing, period_ns)
            self._usual_margin_ns = margin_ns(timing, period_ns, variance, by_events=self._follows_events)
            self._probed_above = (timing.look_variance + _PROBE_BELOW) / 4
        self._margin_ns = self._usual_margin_ns * (1.0 if self._single or self.by_events else self._caution)
        self._probing = self._hits > _UNPROBED or (variance > self._probed_above and not self._follows_events)
        self._aim_ns = estimate.phase_ns + self._margin_ns - timing.look_ns
        if self._probing and self._follows_events:
            self._aim_ns -= 2 * self._margin_ns
        self.quiet_until_ns = estimate.phase_ns - CERTAIN * deviation_ns if self.locked else 0.0

    # -- what an exchange says

    def predict(self, sent_ns: int, back_ns: int) -> None:
        """Say of the new sample that an exchange brought what can be said before learning from it.

        Sets `steps`, `uncertain` and `instant_ns`.
        """
        phase_ns, period_ns = self.estimate.phase_ns, self.estimate.period_ns
        looked_ns, least_ns = self._looked_ns, self._timing.least_ns
        outward_ns = least_ns / 2 + self._passing_ns
        unwatched_ns = back_ns - looked_ns
        if not self._begun:
            self._newest = 1
            # Only what fell into the time the sensor was not watched can have been lost; before the first
            # exchange there was none to lose.
            self.steps = 1 + int(unwatched_ns // period_ns) if looked_ns else 1
            self.uncertain = unwatched_ns >= period_ns
            self.instant_ns = min(back_ns, sent_ns + period_ns)
            return
        self.uncertain = False
        events, self._by_event = self.events, 0.0
        if events is not None and events.are_trusted:
            bias_ns = self._bias_ns if self._single else 0.0
            expected_ns = phase_ns + outward_ns + bias_ns
            late = events.date(expected_ns, period_ns, self.estimate.variance, sent_ns, back_ns)
            if late is not None:
                if self._single:
                    self._bias_ns += _BIAS_GAIN * (late - round(late)) * period_ns
                else:
                    self._by_event = events.instant_ns - outward_ns
                self.uncertain = events.is_doubtful
                self._count(1 + round(late), late, looked_ns - self._seen_by_ns)
                self.instant_ns = min(events.instant_ns, back_ns)
                return
        excess_ns = max(0.0, back_ns - sent_ns - least_ns)
        watched_ns, self._seen_by_ns = looked_ns - self._seen_by_ns, sent_ns + excess_ns
        # A long exchange was a stall after the frame had left, as far as anybody knows: what it brought is
        # dated from before, never as younger than it may be.
        looked_at_ns = sent_ns + (excess_ns / 2 if excess_ns < _LONGEST_LOOK * period_ns else 0.0)
        late = (looked_at_ns - phase_ns) / period_ns
        if unwatched_ns - least_ns < _ONE_ONLY * period_ns:
            # It was seen coming: whichever it was expected next to.
            late = ((looked_ns + looked_at_ns) / 2 - phase_ns) / period_ns
            newest = 1 + round(late)
        else:
            newest = 1 + math.floor(late)
            doubt_ns = CERTAIN * math.sqrt(self.estimate.variance)
            if not self._single:
                doubt_ns += least_ns / 4  # the outward part of a short round trip varies, too
            least = math.floor((sent_ns - phase_ns - doubt_ns) / period_ns)
            most = math.floor((sent_ns + excess_ns - phase_ns + doubt_ns) / period_ns)
            lost_track = events is not None and events.is_doubtful and unwatched_ns > _MISSABLE * period_ns
            self.uncertain = self._doubtful or lost_track or (most > 0 and least < most)
        self._count(newest, late, watched_ns)
        instant_ns = max(phase_ns + (self._newest - 1) * period_ns, looked_ns) + outward_ns
        # After a stall in the exchange its end says nothing of when the sample came to be.
        self.instant_ns = min(instant_ns if self.locked else sent_ns + period_ns, back_ns)
        if events is not None and self.locked and not (events.are_trusted or self.uncertain):
            difference_ns = events.instant_ns - instant_ns
            if variance := events.compare(difference_ns, self.estimate.variance, back_ns):
                self._bias_ns = events.trust.mean_ns
                if not self._single:
                    self.estimate.expect(variance)

    def _count(self, newest: int, late: float, watched_ns: float) -> None:
        """The new sample is this one by the estimate, and so late there, in periods.

        `watched_ns`: for so long exchanges brought nothing new that were sent after it was certain which
        sample is the newest. What does not come while the sensor itself is held up exists all the same.
        """
        if newest < 1:  # too early for the next one: it is that, or the one before was counted twice
            newest = 0 if self._doubtful and late < -0.5 else 1
        self._newest = self.steps = newest
        if self._absent >= SILENT_PERIODS and watched_ns > (SILENT_PERIODS - 1) * self.period_ns:
            self.steps = 1  # a silent sensor is told as such
        elif late > _EARLY:
            self.steps += self._absent  # those that did not come are missing, too

    @property
    def _goes_on(self) -> bool:
        """Whether the new sample is the expected one, after another one that was."""
        return self.steps == self._newest == 1 and not (self.uncertain or self._doubtful or self._overdue)

    def _is_late(self, look_ns: float, variance: float) -> bool:
        """Whether the sample that is expected should have been there at a look."""
        estimate = self.estimate
        return look_ns > estimate.phase_ns + CONTRADICTS * math.sqrt(estimate.variance + variance)

    def observe(self, sent_ns: int, arrived_ns: int, fresh: bool) -> None:
        """Learn from one valid exchange whether it brought a new sample (`fresh`: after `predict`)."""
        estimate, moved_ns = self.estimate, self._timing.moved_ns
        estimate.phase_ns += moved_ns - self._moved_ns
        self._moved_ns = moved_ns
        if self._turn > 0 and fresh and self._by_event and self._goes_on and not estimate.restless:
            # A steady clock need not be learned from every sample.
            self._turn -= 1
            self._hits += 1
            self._looked_ns = sent_ns
            estimate.phase_ns += estimate.period_ns
            self._aim_ns += estimate.period_ns
            self.quiet_until_ns += estimate.period_ns
            return
        look_ns, variance = self._timing.look(sent_ns, arrived_ns)
        looked_ns, self._looked_ns = self._looked_ns, sent_ns
        if not self._begun:
            # The first exchange brings what was there before: it has no instant.
            if fresh and looked_ns:
                self._begun = True
                estimate.begin(max(looked_ns, look_ns - estimate.period_ns), look_ns)
        elif fresh:
            if self._newest != 1:
                estimate.advance(self._newest - 1)
            if self._by_event and self.events is not None:
                estimate.learn_instant(self._by_event, self.events.variance)
            elif self.uncertain:
                pass  # it may be another sample's
            elif self.locked and not (looked_ns > estimate.phase_ns and self._is_late(looked_ns, variance)):
                estimate.learn_bit(look_ns, variance, 1)
            elif look_ns - looked_ns < estimate.period_ns:
                estimate.learn_bracket(looked_ns, look_ns, variance)
            estimate.advance(1)
            self._doubtful = self.uncertain
            if self._hits and not self._by_event:
                self._caution -= _CAUTION_GAIN * _EARLY_POLLS * self._caution
            self._hits += 1
            self._absent = 0
            self._overdue = False
        else:
            doubt_ns = CONTRADICTS * math.sqrt(estimate.variance)
            if (absent := int((sent_ns - estimate.phase_ns - doubt_ns) // estimate.period_ns)) > 0:
                estimate.advance(absent)
                self._absent += absent
            self._overdue = look_ns > estimate.phase_ns + _OVERDUE * math.sqrt(estimate.variance + variance)
            # One in doubt may have been seen already; one that is late may be missing. The next one tells.
            if self.locked and not (self._doubtful or self._is_late(look_ns, variance)):
                if not self._follows_events:
                    estimate.learn_bit(look_ns, variance, -1)
                if look_ns > estimate.phase_ns - doubt_ns - self._margin_ns * (1 + self._follows_events):
                    if self._hits and not self._follows_events:
                        self._caution += _CAUTION_GAIN * self._caution
                        self._caution = min(self._caution, 1.0)
                    self._hits = 0
        self._settle()
