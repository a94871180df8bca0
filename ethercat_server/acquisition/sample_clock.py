"""Follows a sensor's own sampling clock, so that a poll falls right after each sample came to be.

The sensor samples freely; an exchange only tells whether its process data changed since the one before: one
bit. The model is a crystal's: samples come to be at phase + k * period, the period constant but for a slow
wander. The estimate is a Kalman filter's (phase, period and their covariance) whose measurements are those
bits, each taken for the sign of a normally distributed difference. docs/sample-clock.md derives it.

What is not known well, because a frame was lost or the machine stood still, leaves the estimate as it is:
it holds over, and its uncertainty grows at the rate at which crystals wander.
"""

from __future__ import annotations

import math
from typing import Any, Final

from ethercat_server.ethercat.exchange_timing import ExchangeTiming

_ROOT_2_PI: Final = math.sqrt(2 * math.pi)
_ROOT_HALF: Final = math.sqrt(0.5)
_LOCKED: Final = 0.125
"""The clock is followed while the phase is known to this part of a period (standard deviation)."""
_POLLS_UNLOCKED: Final = 4
"""Exchanges a sample while it is not."""
_SEARCH_STEPS: Final = 8
"""Exchanges a sample once one is overdue."""
_JITTER_NS: Final = 30.0
"""How much each period of a crystal differs from the one before, at most."""
_WANDER: Final = 3e-9
"""By what part of it the period changes from sample to sample: 1 ppm in a minute at 1600 Hz."""
_LEAST_LOOK_VARIANCE: Final = 2_000.0**2
_WRONG: Final = 0.005
"""Chance that a bit says nothing: it came from a stall, or was another sample's."""
_MOST_RESTLESS: Final = math.log(1e7)
_RESTLESS_GAIN: Final = 0.05
_RESTLESS_STEP: Final = 0.2
_UNLIKELY_RUN: Final = 7.0
"""Polls in a row that were all late have this negative log-likelihood: about one in a thousand."""
_CONTRADICTS: Final = 3.0
"""A measurement further out than so many standard deviations contradicts the model."""
_CONTRADICTIONS: Final = 4
"""So many in a row mean that the sensor's clock started anew."""
_CERTAIN: Final = 5.0
"""Beyond so many standard deviations a bit that is as expected teaches nothing."""
_UNKNOWN_PHASE: Final = 0.3
"""Standard deviation of a phase of which nothing is known, in periods: 1/sqrt(12)."""
_FIRST_PULL: Final = 0.001
_MOST_PULL: Final = 0.03
"""Standard deviation of the period at first, and after contradictions, as part of it."""
_LARGEST_PULL: Final = 0.12
"""The period may differ from the nominal one by this part. Oscillators are off by 0.0005 at most, but a
simulated sensor that sleeps between its samples is slower by much more."""
PLAUSIBLE_PULL: Final = 0.002
"""A real sensor's period differs from the nominal one by less than this part."""
_PRICE_NS: Final = 50_000.0
"""Age that is given up to save an exchange."""
_LOSS_PERIODS: Final = 10.0
"""Age that is given up to lose no sample, in periods, where there is no time for a second poll."""
_NO_TIME: Final = 0.5
"""There is none if a round trip takes more than this part of a period."""
_LARGEST_MARGIN: Final = 0.4
_LONGEST_LOOK: Final = 0.5
"""The sensor looks at its data within this part of a period after the frame usually has reached it."""
_ONE_ONLY: Final = 0.8
"""Only one sample can have come in this part of a period."""


class SampleClock:
    """The sampling clock of one sensor, as far as the exchanges have shown it. Times are CLOCK_MONOTONIC ns.

    Call `observe` after every valid exchange, before it `predict` if that brought a new sample; ask
    `next_poll_ns` when the next exchange is wanted. Exchanges come in the order in which they were sent.
    """

    __slots__ = (
        "_absent", "_aim_ns", "_begun", "_contradictions", "_covariance", "_doubtful", "_jitter", "_looked_ns",
        "_margin_ns", "_newest", "_nominal_ns", "_overdue", "_period_variance", "_phase_ns", "_phase_variance",
        "_probing", "_pull", "_restless", "_run", "_single", "_timing", "_wander", "instant_ns", "locked",
        "period_ns", "quiet_until_ns", "steps", "uncertain",
    )  # fmt: skip

    def __init__(self, period_ns: float, timing: ExchangeTiming) -> None:
        """`period_ns` is the nominal sample period."""
        self._nominal_ns = period_ns
        self.period_ns = period_ns
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
        self._phase_ns = 0.0
        """When the next sample comes to be, less the outward part of the shortest round trip."""
        self._phase_variance = (_UNKNOWN_PHASE * period_ns) ** 2
        self._covariance = 0.0
        self._period_variance = (_FIRST_PULL * period_ns) ** 2
        self._pull = _FIRST_PULL
        self._restless = 0.0
        """Logarithm of how much more the clock wanders than a crystal: a program that sleeps does."""
        self._jitter = _JITTER_NS**2
        self._wander = (_WANDER * period_ns) ** 2
        """Variances that phase and period gain with each sample."""
        self._looked_ns = 0
        """When the last valid exchange was sent."""
        self._newest = 1
        """Number of the newest sample, counted from the one handed out before it by the phase alone."""
        self._absent = 0
        """Samples that were watched for and did not come."""
        self._begun = False
        """Whether a sample was seen coming."""
        self._doubtful = False
        """Whether the sample before was `uncertain`."""
        self._overdue = False
        self._run = 0.0
        self._contradictions = 0
        self._single = True
        """Whether there is no time for a second poll of a sample."""
        self._probing = False
        """Whether the phase is known worse than polls can tell it."""
        self._margin_ns = 0.0
        self._aim_ns = 0.0
        """When the next poll should be sent."""
        self._settle()

    @property
    def uncertainty_ns(self) -> float:
        """How far `instant_ns` may be off: two standard deviations, and where the slave is on the way."""
        return 2 * math.sqrt(self._phase_variance) + self._timing.least_ns / 2

    @property
    def pull(self) -> float:
        """By what part the period differs from the nominal one."""
        return self.period_ns / self._nominal_ns - 1

    def describe(self) -> dict[str, Any]:
        """What `status` says of it."""
        return {
            "mode": "locked" if self.locked else "oversampling",
            "period_us": self.period_ns / 1000,
            "offset_ppm": round((self._nominal_ns / self.period_ns - 1) * 1e6, 1),
            "uncertainty_us": round(self.uncertainty_ns / 1000, 1) if self.locked else None,
        }

    # -- when to poll

    def next_poll_ns(self) -> float:
        """When the next exchange should be sent, as far as this sensor is concerned."""
        timing, aim_ns, period_ns = self._timing, self._aim_ns, self.period_ns
        sent_ns = timing.sent_ns
        if not self.locked:
            return sent_ns + period_ns / _POLLS_UNLOCKED
        if self._single:
            # The polls that are on their way are for the samples before: the first that has none is next.
            guard_ns = self._margin_ns / 2
            ahead_ns = max(0, int((sent_ns - aim_ns + guard_ns) // period_ns) + 1) * period_ns
            probe_ns = self._phase_ns - timing.look_ns + ahead_ns
            if self._probing and probe_ns > sent_ns + guard_ns:
                return probe_ns
            return aim_ns + ahead_ns
        if timing.in_flight:
            return max(aim_ns, sent_ns + timing.patience_ns)
        if sent_ns < aim_ns:
            return aim_ns
        # It was early: again, at once, or in steps if the sample is overdue.
        return sent_ns + period_ns / _SEARCH_STEPS if self._overdue else sent_ns

    def _settle(self) -> None:
        """Derive from the estimate what the next poll needs."""
        timing, period_ns = self._timing, self.period_ns
        self.locked = self._begun and self._phase_variance < (_LOCKED * period_ns) ** 2
        self._single = timing.usual_ns > _NO_TIME * period_ns
        self._margin_ns = margin_ns(timing, period_ns, self._phase_variance)
        self._aim_ns = self._phase_ns + self._margin_ns - timing.look_ns
        self._probing = self._phase_variance > (timing.look_variance + 6 * _LEAST_LOOK_VARIANCE) / 4
        self.quiet_until_ns = (
            self._phase_ns - _CERTAIN * math.sqrt(self._phase_variance) if self.locked else 0.0
        )

    # -- what an exchange says

    def predict(self, sent_ns: int, back_ns: int) -> None:
        """Say of the new sample that an exchange brought what can be said before learning from it.

        Sets `steps`, `uncertain` and `instant_ns`.
        """
        period_ns, looked_ns, least_ns = self.period_ns, self._looked_ns, self._timing.least_ns
        unwatched_ns = back_ns - looked_ns
        if not self._begun:
            self._newest = 1
            # Only what fell into the time the sensor was not watched can have been lost.
            self.steps = 1 + int(unwatched_ns // period_ns)
            self.uncertain = unwatched_ns >= period_ns
            self.instant_ns = min(back_ns, sent_ns + period_ns) - min(unwatched_ns, period_ns) / 2
            return
        excess_ns = max(0.0, back_ns - sent_ns - least_ns)
        # A long exchange was a stall after the frame had left, as far as anybody knows: what it brought is
        # dated from before, never as younger than it may be.
        late = (sent_ns + min(excess_ns / 2, _LONGEST_LOOK * period_ns) - self._phase_ns) / period_ns
        newest = 1 + math.floor(late)
        self.uncertain = False
        if unwatched_ns - least_ns < _ONE_ONLY * period_ns:
            newest = min(newest, 1)
        else:
            doubt_ns = _CONTRADICTS * math.sqrt(self._phase_variance)
            least = math.floor((sent_ns - self._phase_ns - doubt_ns) / period_ns)
            most = math.floor((sent_ns + excess_ns - self._phase_ns + doubt_ns) / period_ns)
            self.uncertain = self._doubtful or (most > 0 and least < most)
        if newest < 1:  # too early for the next one: it is that, or the one before was counted twice
            newest = 0 if self._doubtful and late < -0.5 else 1
        self._newest = newest
        self.steps = max(0, newest - self._absent)
        instant_ns = self._phase_ns + (newest - 1) * period_ns
        self.instant_ns = min(max(instant_ns, looked_ns) + least_ns / 2, back_ns)

    def observe(self, sent_ns: int, back_ns: int, fresh: bool) -> None:
        """Learn from one valid exchange whether it brought a new sample (`fresh`: after `predict`)."""
        look_ns, variance = self._timing.look(sent_ns, back_ns)
        variance += _LEAST_LOOK_VARIANCE
        looked_ns, self._looked_ns = self._looked_ns, sent_ns
        if not self._begun:
            # The first exchange brings what was there before: it has no instant.
            if fresh and looked_ns:
                self._begun = True
                self._begin(max(looked_ns, look_ns - self.period_ns), look_ns)
        elif fresh:
            self._advance(self._newest - 1)
            if self.uncertain:
                pass  # it may be another sample's
            elif self.locked:
                self._learn_bit(look_ns, variance, 1)
            elif look_ns - looked_ns < self.period_ns:
                self._learn_bracket(looked_ns, look_ns, variance)
            self._doubtful = self.uncertain
            self._advance(1)
            self._absent = 0
            self._overdue = False
        else:
            while sent_ns > self._phase_ns + self.period_ns + _CONTRADICTS * math.sqrt(self._phase_variance):
                self._advance(1)
                self._absent += 1
            self._overdue = look_ns > self._phase_ns + 2 * math.sqrt(self._phase_variance + variance)
            if self.locked:
                self._learn_bit(look_ns, variance, -1)
        self._settle()

    def _begin(self, low_ns: float, high_ns: float) -> None:
        self._phase_ns = (low_ns + high_ns) / 2
        self._phase_variance = (high_ns - low_ns) ** 2 / 12
        self._covariance = 0.0
        self._advance(1)

    def _advance(self, samples: int) -> None:
        """Expect a later sample (an earlier one if negative)."""
        many = abs(samples)
        self._phase_ns += samples * self.period_ns
        self._phase_variance += (
            2 * samples * self._covariance + samples * samples * self._period_variance + many * self._jitter
        )
        self._covariance += samples * self._period_variance
        self._period_variance += many * self._wander
        self._keep_in_bounds()

    def _keep_in_bounds(self) -> None:
        most = (_UNKNOWN_PHASE * self.period_ns) ** 2
        if self._phase_variance > most:
            self._covariance *= math.sqrt(most / self._phase_variance)
            self._phase_variance = most
        most = (self._pull * self.period_ns) ** 2
        if self._period_variance > most:
            self._covariance *= math.sqrt(most / self._period_variance)
            self._period_variance = most

    def _learn_bracket(self, low_ns: float, high_ns: float, variance: float) -> None:
        """While little is known: the sample came to be between these two, anywhere."""
        variance += (high_ns - low_ns) ** 2 / 12
        error_ns = (low_ns + high_ns) / 2 - self._phase_ns
        total = self._phase_variance + variance
        if error_ns * error_ns > _CONTRADICTS * _CONTRADICTS * total:
            if self._contradicted():
                self._phase_ns += error_ns
                self._phase_variance = variance
            return
        self._contradictions = 0
        self._move(error_ns / total)
        self._narrow(1 / total)

    def _learn_bit(self, look_ns: float, variance: float, sign: int) -> None:
        """The sample had come to be at the look (`sign` 1), or had not (-1)."""
        deviation_ns = math.sqrt(self._phase_variance + variance)
        late = (look_ns - self._phase_ns) / deviation_ns
        if sign * late > _CERTAIN:
            self._contradictions = 0
            return
        if sign * late > -_CONTRADICTS:
            self._contradictions = 0
        elif self._contradicted():
            return
        late = max(-8.0, min(8.0, late))
        chance = _WRONG + (0.5 - _WRONG) * math.erfc(-sign * late * _ROOT_HALF)
        slope = (1 - 2 * _WRONG) * sign * math.exp(-late * late / 2) / (_ROOT_2_PI * chance * deviation_ns)
        self._move(-slope)
        surprise = -math.log(chance)
        excess = surprise * (1 - chance) + (1 - chance) * math.log(1 - chance)
        if sign > 0 and late > 0:
            # That a poll was late says nothing of how late: it pulls, but makes nothing more certain.
            self._run += surprise
            if self._run > _UNLIKELY_RUN:
                self._restless += _RESTLESS_STEP
        else:
            self._run = 0.0
            self._narrow(slope * slope + slope * late / deviation_ns)
        self._restless = min(max(self._restless + _RESTLESS_GAIN * excess, 0.0), _MOST_RESTLESS)
        times = math.exp(self._restless)
        self._jitter = times * _JITTER_NS**2
        self._wander = times * (_WANDER * self._nominal_ns) ** 2

    def _move(self, weight: float) -> None:
        self._phase_ns += self._phase_variance * weight
        period_ns, most = self.period_ns + self._covariance * weight, _LARGEST_PULL * self._nominal_ns
        self.period_ns = min(max(period_ns, self._nominal_ns - most), self._nominal_ns + most)

    def _narrow(self, information: float) -> None:
        self._period_variance -= self._covariance * self._covariance * information
        self._covariance -= self._phase_variance * self._covariance * information
        self._phase_variance -= self._phase_variance * self._phase_variance * information

    def _contradicted(self) -> bool:
        """Something did not fit; whether that happened so often that the clock is unknown from here on."""
        self._contradictions += 1
        if self._contradictions < _CONTRADICTIONS:
            return False
        self._contradictions = 0
        self._pull = min(2 * self._pull, _MOST_PULL)
        self._phase_variance = (_UNKNOWN_PHASE * self.period_ns) ** 2
        self._covariance = 0.0
        self._period_variance = max(self._period_variance, (self._pull * self.period_ns) ** 2)
        return True


def margin_ns(timing: ExchangeTiming, period_ns: float, phase_variance: float) -> float:
    """How long after the expected instant a poll should look, so that samples are youngest on the whole.

    An early look costs a second exchange, or the sample where there is no time for one. The margin is where
    a little more of it costs as much as it saves: where the density of the look's instant is 1 / cost.
    """
    single = timing.usual_ns > _NO_TIME * period_ns
    cost_ns = _LOSS_PERIODS * period_ns if single else timing.usual_ns + _PRICE_NS
    deviation_ns = math.sqrt(phase_variance + timing.variance)
    ratio = cost_ns / (deviation_ns * _ROOT_2_PI)
    return min(
        deviation_ns * math.sqrt(2 * math.log(ratio)) if ratio > 1 else 0.0, _LARGEST_MARGIN * period_ns
    )
