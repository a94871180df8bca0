"""The sampling clock of a sensor: phase and period, how well they are known, and when to poll next.

The sensor samples freely; an exchange tells whether its process data changed since the one before, and a
slave controller with a distributed clock when it did (`slave_clock`). From that `Estimate` says when the next
sample comes to be, and `SampleClock` when to look for it. What is not known well, because a frame was lost or
the machine stood still, leaves it as it is: it holds over, and its uncertainty grows as crystals drift.
docs/sample-clock.md derives it. Times are CLOCK_MONOTONIC in ns, variances in ns².
"""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.acquisition.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.slave_clock import EventTimes
from ethercat_server.ethercat.exchange import Latched

# -- the estimate
_ROOT_2_PI: Final = math.sqrt(2 * math.pi)
_ROOT_HALF: Final = math.sqrt(0.5)
_JITTER_NS: Final = 30.0  # period jitter of a crystal, at most
_DRIFT: Final = 3e-9  # relative change of the period from sample to sample: 1 ppm in a minute at 1600 Hz
_LOOK_VARIANCE: Final = 2_000.0**2  # variance of the instant of a look that no round trip shows
# Probability that a bit is meaningless: it came from a stall, or belongs to another sample.
_WRONG: Final = 0.005
_FARTHEST: Final = 8.0
_NOISE_GAIN: Final = 0.05
_NOISE_STEP: Final = 0.4
# Where the phase is a random walk, the rate is uncertain too: exponent of its process noise.
_NOISE_RATE: Final = 1.4
_MOST_NOISE: Final = math.log(1e7)
# Negative log-likelihood of a run of late looks from which noise is raised: about one run in a thousand.
_UNLIKELY_RUN: Final = 7.0
_CONTRADICTS: Final = 3.0  # standard deviations beyond which a measurement contradicts the model
_CONTRADICTIONS: Final = 4  # consecutive contradictions after which the sensor's clock has started anew
_CERTAIN: Final = 5.0  # standard deviations beyond which an expected bit carries no information
_UNKNOWN: Final = 0.3  # standard deviation of an unknown phase, in periods: 1/sqrt(12)
_FIRST_PULL: Final = 0.001
# Largest standard deviation of the period, as part of it; it is reached after contradictions.
_MOST_PULL: Final = 0.03
# The period may differ from the nominal one by this part. Oscillators are off by 0.0005 at most, but a
# simulated sensor that sleeps between its samples is slower by much more.
_LARGEST_PULL: Final = 0.12
_STEADY: Final = 2e-6  # relative standard deviation of the period below which it counts as known
# -- the margin
# Cost of an exchange, as age.
_PRICE_NS: Final = 15_000.0
# Cost of a lost sample, as age in periods, where there is no time for a second poll.
_LOSS_PERIODS: Final = 10.0
_NO_TIME: Final = 0.5  # round trip, in periods, beyond which there is no time for one
_LARGEST_MARGIN: Final = 0.4
# Factor by which an early look costs more where nothing is learned from it: events date the samples.
_NOTHING_LEARNED: Final = 1.2
# -- the clock
# Standard deviation of the phase, in periods, below which the clock is followed.
_LOCKED: Final = 0.125
_POLLS_UNLOCKED: Final = 4  # exchanges per sample while it is not
_SEARCH_STEPS: Final = 8  # exchanges per period once a sample is overdue
_OVERDUE: Final = 2.0  # standard deviations after which it is
PLAUSIBLE_PULL: Final = 0.002  # a real sensor's period differs from the nominal one by less than this part
SILENT_PERIODS: Final = 3  # periods without a new sample after which a sensor is silent, not just late
_EARLY_POLLS: Final = 0.11  # fraction of the samples whose first poll is to be early
_CAUTION_GAIN: Final = 0.05
# Calls of `learn` after which the margin is derived anew, and change of the variance by which it is at once.
_TURNS: Final = 3
_CHANGED: Final = 1.25
# Interval at which a steady clock learns from a sample: by its event, and by polls.
_LEARN_BY_EVENT_EVERY_NS: Final = 10e6
_LEARN_BY_POLL_EVERY_NS: Final = 6.25e6
# Variance of the phase below which no probes are needed, however precise polls are.
_PROBE_BELOW: Final = 5_000.0**2
_UNPROBED: Final = 500  # samples without an early look after which the phase is probed
# Excess of an exchange, in periods, beyond which it says nothing of when the sensor looked.
_LONGEST_LOOK: Final = 0.5
_EARLY: Final = -0.25  # lateness in periods below which a sample is the one expected before
_BIAS_GAIN: Final = 1 / 64
# Time without a look, in periods: below the first only one sample can have come, above the second more may.
_ONE_ONLY, _MISSABLE = 0.8, 1.25


class Estimate:
    """Phase and period of one clock. Times in ns, variances in ns²."""

    def __init__(self, period_ns: float) -> None:
        """`period_ns` is the nominal period."""
        self._nominal_ns = period_ns
        self.period_ns = period_ns
        self.phase_ns = 0.0  # when the next sample comes to be
        self.variance = (_UNKNOWN * period_ns) ** 2  # of the phase
        self._covariance = 0.0
        self._period_variance = (_FIRST_PULL * period_ns) ** 2
        self._pull = _FIRST_PULL
        self._jitter = _JITTER_NS**2
        self._drift = (_DRIFT * period_ns) ** 2  # variances that phase and period gain with each sample
        # Logarithm of the factor by which its process noise exceeds a crystal's, as that of a program does.
        self.excess_noise = 0.0
        self._run = 0.0  # negative log-likelihood of the looks since the last that was early
        self._contradictions = 0

    @property
    def pull(self) -> float:
        """Relative deviation of the period from the nominal one."""
        return self.period_ns / self._nominal_ns - 1

    @property
    def is_steady(self) -> bool:
        """Whether the clock runs as a crystal does, and its period is known."""
        return not self.excess_noise and self._period_variance < (_STEADY * self.period_ns) ** 2

    def begin(self, low_ns: float, high_ns: float) -> None:
        """The first sample came to be between these two; the next one is expected."""
        self.phase_ns = (low_ns + high_ns) / 2
        self.variance = (high_ns - low_ns) ** 2 / 12
        self._covariance = 0.0
        self.advance(1)

    def advance(self, samples: int) -> None:
        """Expect a later sample (an earlier one if negative)."""
        self.phase_ns += samples * self.period_ns
        self.hold_over(samples)

    def hold_over(self, samples: int) -> None:
        """Have the variances grow as those samples make them."""
        many = abs(samples)
        self.variance += 2 * samples * self._covariance + many * (many * self._period_variance + self._jitter)
        self._covariance += samples * self._period_variance
        self._period_variance += many * self._drift
        if self.variance > (most := (_UNKNOWN * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self.variance)
            self.variance = most
        if self._period_variance > (most := (_MOST_PULL * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self._period_variance)
            self._period_variance = most

    def learn_bracket(self, low_ns: float, high_ns: float, variance: float) -> None:
        """While little is known: the sample came to be between these two, anywhere."""
        variance += (high_ns - low_ns) ** 2 / 12 + _LOOK_VARIANCE
        error_ns = (low_ns + high_ns) / 2 - self.phase_ns
        total = self.variance + variance
        if error_ns * error_ns > _CONTRADICTS * _CONTRADICTS * total:
            if self._is_contradicted():
                self.phase_ns += error_ns
                self.variance = variance
            return
        self._contradictions = 0
        self._move(error_ns / total)
        self._narrow(1 / total)

    def learn_bit(self, look_ns: float, variance: float, sign: int) -> None:
        """The sample had come to be at the look (`sign` 1), or had not (-1)."""
        deviation_ns = math.sqrt(self.variance + variance + _LOOK_VARIANCE)
        late = (look_ns - self.phase_ns) / deviation_ns
        if sign * late > _CERTAIN:
            return
        if sign * late < -_CONTRADICTS:
            if self._is_contradicted():
                return
        elif sign > 0:
            self._contradictions = 0
        if not -_FARTHEST < late < _FARTHEST:
            late = math.copysign(_FARTHEST, late)
        chance = _WRONG + (0.5 - _WRONG) * math.erfc(-sign * late * _ROOT_HALF)
        slope = (1 - 2 * _WRONG) * sign * math.exp(-late * late / 2) / (_ROOT_2_PI * chance * deviation_ns)
        self._move(-slope)
        surprise = -math.log(chance)
        if sign > 0 and late > 0:
            # A late look bounds the phase on one side only: it pulls, but reduces no variance.
            self._run += surprise
            if self._run > _UNLIKELY_RUN:
                self.excess_noise += _NOISE_STEP
        else:
            self._run = 0.0
            self._narrow(slope * slope + slope * late / deviation_ns)
        self._adapt_noise((1 - chance) * (surprise + math.log(1 - chance)))

    def learn_instant(self, instant_ns: float, variance: float) -> None:
        """The sample came to be then."""
        error_ns, total = instant_ns - self.phase_ns, self.variance + variance
        surprise = error_ns * error_ns / total
        if surprise > _CONTRADICTS * _CONTRADICTS:
            if self._is_contradicted():
                self._move(error_ns / self.variance)
            return
        self._contradictions = 0
        self._move(error_ns / total)
        self._narrow(1 / total)
        self._adapt_noise((surprise - 1) / 2)

    def expect(self, variance: float) -> None:
        """The instants have about this variance about those of a crystal."""
        self._adapt_noise(math.log(max(variance, _JITTER_NS**2) / _JITTER_NS**2) / _NOISE_GAIN)

    def _adapt_noise(self, excess: float) -> None:
        """A measurement was more surprising than the model expects, by `excess`."""
        excess_noise = self.excess_noise + _NOISE_GAIN * excess
        if excess_noise > 0 or self.excess_noise > 0:
            self.excess_noise = min(max(excess_noise, 0.0), _MOST_NOISE)
            self._jitter = math.exp(self.excess_noise) * _JITTER_NS**2
            self._drift = math.exp(_NOISE_RATE * self.excess_noise) * (_DRIFT * self._nominal_ns) ** 2

    def _move(self, weight: float) -> None:
        self.phase_ns += self.variance * weight
        period_ns, most = self.period_ns + self._covariance * weight, _LARGEST_PULL * self._nominal_ns
        if -most < period_ns - self._nominal_ns < most:
            self.period_ns = period_ns

    def _narrow(self, information: float) -> None:
        self._period_variance -= self._covariance * self._covariance * information
        self._covariance -= self.variance * self._covariance * information
        self.variance -= self.variance * self.variance * information

    def _is_contradicted(self) -> bool:
        """A measurement did not fit; whether as many did that the phase is unknown from here on."""
        self._contradictions += 1
        if self._contradictions < _CONTRADICTIONS:
            return False
        self._contradictions = 0
        self._pull = min(2 * self._pull, _MOST_PULL)
        self.variance = (_UNKNOWN * self.period_ns) ** 2
        self._covariance = 0.0
        self._period_variance = max(self._period_variance, (self._pull * self.period_ns) ** 2)
        return True


class SampleClock:
    """The sampling clock of one sensor, as observed through the exchanges.

    Call `take` for every valid exchange, in the order in which they were sent, then `learn` unless it
    `goes_on`; ask `next_poll_ns` when the next exchange is wanted. Exchanges are back when this program has
    them, and arrive when their first byte does.

    Attributes:
        events: what the slave controller says; None if it says nothing.
        estimate: its phase is the next sample's instant less the outward part of the shortest round trip.
        locked: whether the phase is known well enough to follow it.
        instant_ns: estimated instant of the newest sample, from those before it.
        steps: how many samples the newest one is after the one handed out before it: more than 1, some were
            lost; 0, one was counted as lost that was not.
        uncertain: whether more may have been lost than `steps` says. The samples after it tell, and their
            `steps` put it right.
        quiet_ns: an exchange that is back this long before the phase certainly brings nothing new.
    """

    __slots__ = (
        "_absent", "_aim_after_ns", "_begun", "_bias_ns", "_by_event", "_caution", "_doubt_ns", "_doubtful",
        "_fresh", "_hits", "_late_ns", "_least_variance", "_looked_ns", "_margin_ns", "_most_variance",
        "_moved_ns", "_newest", "_outward_ns", "_overdue", "_passing_ns", "_probed_above", "_probing",
        "_seen_by_ns", "_sent_ns", "_single", "_skipped", "_skips", "_steady", "_sure_ns", "_timing", "_turn",
        "_usual_margin_ns", "estimate", "events", "instant_ns", "locked", "quiet_ns", "steps",
        "uncertain",
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
        self._passing_ns = passing_ns
        self._timing = timing
        self.locked = False
        self.instant_ns = 0.0
        self.steps = 1
        self.uncertain = False
        self.quiet_ns = math.inf
        # The last exchange: when it was sent, and whether it brought a new sample.
        self._sent_ns, self._fresh = 0, False
        self._by_event = 0.0  # instant of the newest sample by its event, less the outward part; 0: unknown
        # When the last valid exchange was sent from which was learned, or that went on.
        self._looked_ns = 0
        self._moved_ns = timing.moved_ns
        self._bias_ns = 0.0  # by how much events are later than polls show, while polls are followed
        self._newest = 1  # number of the newest sample, counted from the one before it by the phase alone
        # When the sensor had certainly looked in the exchange that brought the newest sample.
        self._seen_by_ns = 0.0
        self._absent = 0  # consecutive samples that were polled for and did not come
        # Whether an instant is known; whether the sample before was `uncertain`; whether the next is overdue.
        self._begun = self._doubtful = self._overdue = False
        self._single = True  # whether there is no time for a second poll of a sample
        # Whether the next poll is to be early: polls can tell the phase better, or did not for long.
        self._probing = False
        self._hits = 0  # samples since a look was early
        # κ, the fraction of the margin that is needed: looks are distributed less evenly than it assumes.
        self._caution = 1.0
        # Between these variances the margin is as it was derived last.
        self._turn, self._least_variance, self._most_variance = 0, 0.0, 0.0
        self._usual_margin_ns = self._margin_ns = self._probed_above = 0.0
        self._aim_after_ns = 0.0  # how long after the phase the next poll should be sent
        # Whether the next sample is certainly the expected one if its exchange is back less than `_sure_ns`
        # after its phase; its event is then within `_doubt_ns` of it, and it is overdue after `_late_ns`.
        self._steady = False
        self._sure_ns = self._doubt_ns = self._late_ns = self._outward_ns = 0.0
        # Samples since something was learned, and how many at most.
        self._skipped = self._skips = 0
        self._settle()

    @property
    def period_ns(self) -> float:
        """Estimated period."""
        return self.estimate.period_ns

    @property
    def uncertainty_ns(self) -> float:
        """Uncertainty of `instant_ns`: two standard deviations, and the asymmetry of the round trip.

        What a round trip usually takes beyond the shortest may be on either way, which cannot be observed. A
        sample that may be mistaken for another may be off by a period.
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

        Where an early poll costs a sample, polls are timed by polls only: the asymmetry of a long round trip
        may put event times off by more than polls tolerate.
        """
        return self.by_events and not self._single

    @property
    def one_by_one(self) -> bool:
        """Whether it is followed, and an exchange is back before the next one is wanted."""
        return self.locked and not self._single

    # -- when to poll

    def next_poll_ns(self) -> float:
        """When the next exchange should be sent, as far as this sensor is concerned."""
        timing, aim_ns = self._timing, self.estimate.phase_ns + self._aim_after_ns
        sent_ns, period_ns = timing.sent_ns, self.estimate.period_ns
        if self._steady and sent_ns < aim_ns and not timing.in_flight:
            return aim_ns
        if not self.locked:
            return sent_ns + period_ns / _POLLS_UNLOCKED
        if self._single:
            # The polls in flight are for the samples before: the next is for the first that has none.
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
        # It was early: poll again at once, or in steps if the sample is overdue.
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
            self._single = timing.usual_ns > _NO_TIME * period_ns
            if not self._single:  # phase and period are learned from events again
                estimate.phase_ns += self._bias_ns
                self._bias_ns = 0.0
            self._usual_margin_ns = self._best_margin_ns()
            self._probed_above = (timing.look_variance + _PROBE_BELOW) / 4
        self._margin_ns = self._usual_margin_ns * (1.0 if self._single or self.by_events else self._caution)
        self._probing = self._hits > _UNPROBED or (variance > self._probed_above and not self._follows_events)
        self._aim_after_ns = self._margin_ns - timing.look_ns
        if self._probing and self._follows_events:
            self._aim_after_ns -= 2 * self._margin_ns
        self.quiet_ns = _CERTAIN * deviation_ns if self.locked else math.inf
        events, self._outward_ns = self.events, timing.least_ns / 2 + self._passing_ns
        doubt_ns = self._doubt_ns = _CERTAIN * math.sqrt(variance + (events.variance if events else 0.0))
        self._sure_ns = period_ns + timing.least_ns * 3 / 4 - doubt_ns
        self._late_ns = _OVERDUE * math.sqrt(variance + timing.look_variance)
        self._steady = (
            self.locked
            and not (self._single or self._absent or 2 * doubt_ns > period_ns)
            and estimate.is_steady
            and 8 * timing.excess_ns < period_ns
            and self._goes_on
            and (events is None or events.is_steady)
        )

    def _best_margin_ns(self) -> float:
        """How long after the expected instant a poll should look, so that samples are youngest on the whole.

        An early look costs a second exchange, or the sample where there is no time for one. The margin is
        where a little more of it costs as much as it saves: where the density of the look's instant is
        1 / cost.
        """
        timing, period_ns = self._timing, self.estimate.period_ns
        cost_ns = _LOSS_PERIODS * period_ns if self._single else timing.usual_ns + _PRICE_NS
        if self._follows_events:
            cost_ns *= _NOTHING_LEARNED
        deviation_ns = math.sqrt(self.estimate.variance + timing.variance)
        ratio = cost_ns / (deviation_ns * _ROOT_2_PI)
        if ratio <= 1:
            return 0.0
        return min(deviation_ns * math.sqrt(2 * math.log(ratio)), _LARGEST_MARGIN * period_ns)

    # -- what an exchange says

    def take(self, sent_ns: int, back_ns: int, latched: Latched | None, *, fresh: bool) -> bool:
        """Date what an exchange brought, before learning from it; whether it is certainly the next sample.

        `latched` is what the slave controller has latched. If it brought a new sample (`fresh`) this sets
        `steps`, `uncertain` and `instant_ns`.
        """
        self._sent_ns, self._fresh, events = sent_ns, fresh, self.events
        if latched is not None and events is not None:
            events.take(latched, sent_ns, back_ns, fresh, self.estimate.period_ns)
        if not fresh:
            return False
        phase_ns, outward_ns = self.estimate.phase_ns, self._outward_ns
        if self._steady and back_ns < phase_ns + self._sure_ns:
            if events is None or not events.are_trusted:
                instant_ns = max(phase_ns, self._looked_ns) + outward_ns
                self._seen_by_ns = back_ns
            else:
                instant_ns = events.instant_ns
                self._by_event = instant_ns - outward_ns
            if -self._doubt_ns < instant_ns - outward_ns - phase_ns < self._doubt_ns:
                self.instant_ns = instant_ns if instant_ns < back_ns else back_ns
                return True
        self._skips = 0
        self._predict(sent_ns, back_ns)
        return self.steps == 1 and not self.uncertain

    def goes_on(self) -> bool:
        """Whether the last exchange needs no `learn`: a steady clock is learned from some samples only.

        Which ones is decided before they come: early and late looks must not be selected by what they say.
        """
        if self._skipped >= self._skips or self._timing.moved_ns != self._moved_ns:
            return False
        if self._fresh:
            self._skipped += 1
            self.estimate.phase_ns += self.estimate.period_ns
        elif self._sent_ns > self.estimate.phase_ns + self._late_ns:
            return False
        else:
            self._hits = 0
        self._looked_ns = self._sent_ns
        return True

    def _predict(self, sent_ns: int, back_ns: int) -> None:
        """Date a new sample where it may not be the expected one."""
        phase_ns, period_ns = self.estimate.phase_ns, self.estimate.period_ns
        looked_ns, least_ns = self._looked_ns, self._timing.least_ns
        outward_ns = least_ns / 2 + self._passing_ns
        unwatched_ns = back_ns - looked_ns
        if not self._begun:
            self._newest = 1
            # Only what came while the sensor was not polled can have been lost; before the first exchange
            # there was nothing to lose.
            self.steps = 1 + int(unwatched_ns // period_ns) if looked_ns else 1
            self.uncertain = unwatched_ns >= period_ns
            self.instant_ns = min(back_ns, sent_ns + period_ns)
            return
        self.uncertain = False
        events, self._by_event = self.events, 0.0
        if events is not None and events.are_trusted:
            expected_ns = phase_ns + outward_ns + self._bias_ns
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
        # A long exchange is taken for a stall after the frame had left: what it brought is dated from before,
        # never as younger than it may be.
        looked_at_ns = sent_ns + (excess_ns / 2 if excess_ns < _LONGEST_LOOK * period_ns else 0.0)
        late = (looked_at_ns - phase_ns) / period_ns
        doubt_ns = _CERTAIN * math.sqrt(self.estimate.variance)
        if not self._single:
            doubt_ns += least_ns / 4  # the outward part of a short round trip varies, too
        most = math.floor((sent_ns + excess_ns - phase_ns + doubt_ns) / period_ns)
        if unwatched_ns - least_ns < _ONE_ONLY * period_ns:
            # It came between two looks: it is the one expected nearest to them. By events the phase is so
            # exact that no sample can have come before it: it was held back.
            late = ((looked_ns + looked_at_ns) / 2 - phase_ns) / period_ns
            newest = 1 + (min(round(late), most) if events is not None else round(late))
        else:
            newest = 1 + math.floor(late)
            least = math.floor((sent_ns - phase_ns - doubt_ns) / period_ns)
            lost_track = events is not None and events.is_doubtful and unwatched_ns > _MISSABLE * period_ns
            self.uncertain = self._doubtful or lost_track or (most > 0 and least < most)
        self._count(newest, late, watched_ns)
        instant_ns = max(phase_ns + (self._newest - 1) * period_ns, looked_ns) + outward_ns
        # After a stall in the exchange its end says nothing of the sample's instant.
        self.instant_ns = min(instant_ns if self.locked else sent_ns + period_ns, back_ns)
        if events is not None and self.locked and not (events.are_trusted or self.uncertain):
            difference_ns = events.instant_ns - instant_ns
            if variance := events.compare(difference_ns, self.estimate.variance, back_ns):
                self._bias_ns = events.trust.mean_ns
                if not self._single:
                    self.estimate.expect(variance)

    def _count(self, newest: int, late: float, watched_ns: float) -> None:
        """Set `steps`: the new sample is number `newest` by the phase, and `late` periods later than that.

        `watched_ns`: time in which exchanges brought nothing new that were sent after the newest sample was
        identified. Samples that pass while the slave holds up the frames exist, although none brings them.
        """
        if newest < 1:  # too early for the next one: it is that, or one too many was counted before
            newest = 0 if self._doubtful and late < -0.5 else 1
        self._newest = self.steps = newest
        if self._absent >= SILENT_PERIODS and watched_ns > (SILENT_PERIODS - 1) * self.period_ns:
            self.steps = 1  # a silent sensor loses nothing
        elif late > _EARLY:
            self.steps += self._absent

    @property
    def _goes_on(self) -> bool:
        """Whether the new sample is the expected one, after another one that was."""
        return self.steps == self._newest == 1 and not (self.uncertain or self._doubtful or self._overdue)

    def _is_late(self, look_ns: float, variance: float) -> bool:
        """Whether a look came so late that the expected sample must have come, or was skipped."""
        estimate = self.estimate
        return look_ns > estimate.phase_ns + _CONTRADICTS * math.sqrt(estimate.variance + variance)

    def learn_events(self, sent_ns: int, arrived_ns: int, count: int) -> None:
        """Learn when events come to be; `count` exchanges are known by this one."""
        if self.events is None:
            return
        moved_ns = self.events.local_clock.moved_ns
        self.events.learn(sent_ns, arrived_ns, count)
        if self._follows_events:  # all events are earlier or later, and so are the samples
            self.estimate.phase_ns += self.events.local_clock.moved_ns - moved_ns

    def learn(self, arrived_ns: int) -> None:  # noqa: PLR0915 - one step of one filter
        """Learn from the exchange that was taken last, whose answer began to arrive at `arrived_ns`."""
        estimate, moved_ns = self.estimate, self._timing.moved_ns
        sent_ns, fresh = self._sent_ns, self._fresh
        estimate.phase_ns += moved_ns - self._moved_ns
        self._moved_ns = moved_ns
        self.learn_events(sent_ns, arrived_ns, 1 + self._skipped)
        if self._skipped:
            estimate.hold_over(self._skipped)
            self._hits += self._skipped
            self._skipped = 0
        look_ns, variance = self._timing.look(sent_ns, arrived_ns)
        looked_ns, self._looked_ns = self._looked_ns, sent_ns
        if not self._begun:
            # The instant of what the first exchange brings is unknown.
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
            doubt_ns = _CONTRADICTS * math.sqrt(estimate.variance)
            if (absent := int((sent_ns - estimate.phase_ns - doubt_ns) // estimate.period_ns)) > 0:
                estimate.advance(absent)
                self._absent += absent
            self._overdue = look_ns > estimate.phase_ns + _OVERDUE * math.sqrt(estimate.variance + variance)
            # In doubt it may have been seen already; late it may have been skipped: the next one shows.
            if self.locked and not (self._doubtful or self._is_late(look_ns, variance)):
                if not self._follows_events:
                    estimate.learn_bit(look_ns, variance, -1)
                if look_ns > estimate.phase_ns - doubt_ns - self._margin_ns * (1 + self._follows_events):
                    if self._hits and not self._follows_events:
                        self._caution += _CAUTION_GAIN * self._caution
                        self._caution = min(self._caution, 1.0)
                    self._hits = 0
        self._settle()
        every_ns = _LEARN_BY_EVENT_EVERY_NS if self.by_events else _LEARN_BY_POLL_EVERY_NS
        self._skips = round(every_ns / estimate.period_ns) - 1 if self._steady and fresh else 0
