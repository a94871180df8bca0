"""Phase and period of a sensor's sampling clock, estimated from exchanges that tell one bit each.

The model is a crystal's: samples come to be at phase + k * period, the period constant but for a slow
wander. The estimate is a Kalman filter's: phase, period and their covariance. What it measures is the sign of
a normally distributed difference, the instant of a look less that of the sample; docs/sample-clock.md derives
it.
"""

from __future__ import annotations

import math
from typing import Final

ROOT_2_PI: Final = math.sqrt(2 * math.pi)
_ROOT_HALF: Final = math.sqrt(0.5)
_JITTER_NS: Final = 30.0
"""How much each period of a crystal differs from the one before, at most."""
_WANDER: Final = 3e-9
"""By what part of it the period changes from sample to sample: 1 ppm in a minute at 1600 Hz."""
_LEAST_VARIANCE: Final = 2_000.0**2
"""Of the instant of a look: what shows of it in no round trip."""
_WRONG: Final = 0.005
"""Chance that a bit says nothing: it came from a stall, or was another sample's."""
_FARTHEST: Final = 8.0
_RESTLESS_GAIN: Final = 0.05
_RESTLESS_STEP: Final = 0.4
_RESTLESS_RATE: Final = 1.4
"""A clock whose phase walks is of unknown rate, too."""
_MOST_RESTLESS: Final = math.log(1e7)
_UNLIKELY_RUN: Final = 7.0
"""Looks in a row that were all late have this negative log-likelihood: about one in a thousand."""
CONTRADICTS: Final = 3.0
"""A measurement further out than so many standard deviations contradicts the model."""
_CONTRADICTIONS: Final = 4
"""So many in a row mean that the sensor's clock started anew."""
CERTAIN: Final = 5.0
"""Beyond so many standard deviations a bit that is as expected teaches nothing."""
_UNKNOWN: Final = 0.3
"""Standard deviation of a phase of which nothing is known, in periods: 1/sqrt(12)."""
_FIRST_PULL: Final = 0.001
_MOST_PULL: Final = 0.03
"""Standard deviation of the period at first, and after contradictions, as part of it."""
_LARGEST_PULL: Final = 0.12
"""The period may differ from the nominal one by this part. Oscillators are off by 0.0005 at most, but a
simulated sensor that sleeps between its samples is slower by much more."""


class Estimate:
    """Of one clock. Times in ns, variances in ns²."""

    __slots__ = (
        "_contradictions", "_covariance", "_jitter", "_nominal_ns", "_period_variance", "_pull", "_run",
        "_wander", "period_ns", "phase_ns", "restless", "variance",
    )  # fmt: skip

    def __init__(self, period_ns: float) -> None:
        """`period_ns` is the nominal period."""
        self._nominal_ns = period_ns
        self.period_ns = period_ns
        self.phase_ns = 0.0
        """When the next sample comes to be."""
        self.variance = (_UNKNOWN * period_ns) ** 2
        """Of the phase."""
        self._covariance = 0.0
        self._period_variance = (_FIRST_PULL * period_ns) ** 2
        self._pull = _FIRST_PULL
        self._jitter = _JITTER_NS**2
        self._wander = (_WANDER * period_ns) ** 2
        """Variances that phase and period gain with each sample."""
        self.restless = 0.0
        """Logarithm of how much more the clock wanders than a crystal: a program that sleeps does."""
        self._run = 0.0
        """Negative log-likelihood of the looks since the last that was early."""
        self._contradictions = 0

    @property
    def pull(self) -> float:
        """By what part the period differs from the nominal one."""
        return self.period_ns / self._nominal_ns - 1

    def begin(self, low_ns: float, high_ns: float) -> None:
        """The first sample came to be between these two; the next one is expected."""
        self.phase_ns = (low_ns + high_ns) / 2
        self.variance = (high_ns - low_ns) ** 2 / 12
        self._covariance = 0.0
        self.advance(1)

    def advance(self, samples: int) -> None:
        """Expect a later sample (an earlier one if negative)."""
        many = abs(samples)
        self.phase_ns += samples * self.period_ns
        self.variance += 2 * samples * self._covariance + many * (many * self._period_variance + self._jitter)
        self._covariance += samples * self._period_variance
        self._period_variance += many * self._wander
        if self.variance > (most := (_UNKNOWN * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self.variance)
            self.variance = most
        if self._period_variance > (most := (_MOST_PULL * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self._period_variance)
            self._period_variance = most

    def learn_bracket(self, low_ns: float, high_ns: float, variance: float) -> None:
        """While little is known: the sample came to be between these two, anywhere."""
        variance += (high_ns - low_ns) ** 2 / 12 + _LEAST_VARIANCE
        error_ns = (low_ns + high_ns) / 2 - self.phase_ns
        total = self.variance + variance
        if error_ns * error_ns > CONTRADICTS * CONTRADICTS * total:
            if self._is_contradicted():
                self.phase_ns += error_ns
                self.variance = variance
            return
        self._contradictions = 0
        self._move(error_ns / total)
        self._narrow(1 / total)

    def learn_bit(self, look_ns: float, variance: float, sign: int) -> None:
        """The sample had come to be at the look (`sign` 1), or had not (-1)."""
        deviation_ns = math.sqrt(self.variance + variance + _LEAST_VARIANCE)
        late = (look_ns - self.phase_ns) / deviation_ns
        if sign * late > CERTAIN:
            return
        if sign * late < -CONTRADICTS:
            if self._is_contradicted():
                return
        elif sign > 0:
            self._contradictions = 0
        if not -_FARTHEST < late < _FARTHEST:
            late = math.copysign(_FARTHEST, late)
        chance = _WRONG + (0.5 - _WRONG) * math.erfc(-sign * late * _ROOT_HALF)
        slope = (1 - 2 * _WRONG) * sign * math.exp(-late * late / 2) / (ROOT_2_PI * chance * deviation_ns)
        self._move(-slope)
        surprise = -math.log(chance)
        if sign > 0 and late > 0:
            # That a look was late says nothing of how late: it pulls, but makes nothing more certain.
            self._run += surprise
            if self._run > _UNLIKELY_RUN:
                self.restless += _RESTLESS_STEP
        else:
            self._run = 0.0
            self._narrow(slope * slope + slope * late / deviation_ns)
        self._stir((1 - chance) * (surprise + math.log(1 - chance)))

    def learn_instant(self, instant_ns: float, variance: float) -> None:
        """The sample came to be then."""
        error_ns, total = instant_ns - self.phase_ns, self.variance + variance
        surprise = error_ns * error_ns / total
        if surprise > CONTRADICTS * CONTRADICTS:
            if self._is_contradicted():
                self._move(error_ns / self.variance)
            return
        self._contradictions = 0
        self._move(error_ns / total)
        self._narrow(1 / total)
        self._stir((surprise - 1) / 2)

    def expect(self, variance: float) -> None:
        """Instants are about so far from those of a crystal."""
        self._stir(math.log(max(variance, _JITTER_NS**2) / _JITTER_NS**2) / _RESTLESS_GAIN)

    def _stir(self, excess: float) -> None:
        """Something was more surprising than the model has it, by so much."""
        restless = self.restless + _RESTLESS_GAIN * excess
        if restless > 0 or self.restless > 0:
            self.restless = min(max(restless, 0.0), _MOST_RESTLESS)
            self._jitter = math.exp(self.restless) * _JITTER_NS**2
            self._wander = math.exp(_RESTLESS_RATE * self.restless) * (_WANDER * self._nominal_ns) ** 2

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
        """Something did not fit; whether that happened so often that the clock is unknown from here on."""
        self._contradictions += 1
        if self._contradictions < _CONTRADICTIONS:
            return False
        self._contradictions = 0
        self._pull = min(2 * self._pull, _MOST_PULL)
        self.variance = (_UNKNOWN * self.period_ns) ** 2
        self._covariance = 0.0
        self._period_variance = max(self._period_variance, (self._pull * self.period_ns) ** 2)
        return True
