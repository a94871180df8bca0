"""The one filter of offset and rate: of a sensor's sampling clock, and of a slave controller's local clock.

A clock counts steps: a sensor's samples, or the ns of a slave controller's local time. The filter (Kalman,
for single bits assumed-density) estimates when a step happens and how long steps are; docs/sample-clock.md
has the formulas. Process noise is what a crystal does, until measurements are more surprising than that.
"""

from __future__ import annotations

import math
from typing import Final

_ROOT_2_PI: Final = math.sqrt(2 * math.pi)
_ROOT_HALF: Final = math.sqrt(0.5)
# Standard deviations: beyond the first a measurement contradicts the model, beyond the second it cannot be.
CONTRADICTS: Final = 3.0
CERTAIN: Final = 5.0
_JITTER_NS: Final = 30.0  # period jitter of a crystal, at most
_DRIFT: Final = 3e-9  # relative change of the period from sample to sample: 1 ppm in a minute at 1600 Hz
READ_VARIANCE: Final = 2_000.0**2  # variance of the instant of a PDI read that no round trip shows
# Probability that a bit is meaningless: it came from a stall, or belongs to another sample.
_WRONG: Final = 0.005
_FARTHEST: Final = 8.0
_NOISE_GAIN: Final = 0.05
_NOISE_STEP: Final = 0.4
# Where the phase is a random walk, the rate is uncertain too: exponent of its process noise.
_NOISE_RATE: Final = 1.4
_MOST_NOISE: Final = math.log(1e7)
# Negative log-likelihood of a run of late reads from which noise is raised: about one run in a thousand.
_UNLIKELY_RUN: Final = 7.0
_CONTRADICTIONS: Final = 4  # consecutive contradictions after which the sensor's clock has started anew
_UNKNOWN: Final = 0.3  # standard deviation of an unknown phase, in periods: 1/sqrt(12)
_FIRST_ERROR: Final = 0.001
# Largest standard deviation of the period, as part of it; it is reached after contradictions.
_MOST_ERROR: Final = 0.03
# The period may differ from the nominal one by this part. Oscillators are off by 0.0005 at most, but a
# simulated sensor that sleeps between its samples is slower by much more.
_LARGEST_ERROR: Final = 0.12
_STEADY: Final = 2e-6  # relative standard deviation of the period below which it counts as known


class Phase:
    """When a step of a clock happens, and how long steps take.

    Attributes:
        phase_ns: when the step happens that is expected.
        period_ns: how long a step takes.
        variance: of `phase_ns`.
        period_variance: of `period_ns`.
    """

    __slots__ = (
        "_covariance", "_period_noise", "_phase_noise", "period_ns", "period_variance", "phase_ns", "variance"
    )  # fmt: skip

    def __init__(
        self, phase_ns: float, period_ns: float, variance: float, period_variance: float,
        phase_noise: float, period_noise: float,
    ) -> None:  # fmt: skip
        """`phase_noise` and `period_noise` are the variances that both gain with each step."""
        self.phase_ns, self.period_ns = phase_ns, period_ns
        self.variance, self._covariance, self.period_variance = variance, 0.0, period_variance
        self._phase_noise, self._period_noise = phase_noise, period_noise

    def advance(self, steps: int) -> None:
        """Expect a later step (an earlier one if negative)."""
        self.phase_ns += steps * self.period_ns
        self.hold_over(steps)

    def hold_over(self, steps: int) -> None:
        """Have the variances grow as those steps make them."""
        many = abs(steps)
        self.variance += 2 * steps * self._covariance + many * (
            many * self.period_variance + self._phase_noise
        )
        self._covariance += steps * self.period_variance
        self.period_variance += many * self._period_noise

    def correct(self, error_ns: float, variance: float) -> None:
        """The step happened `error_ns` later than expected, by a measurement with this variance."""
        total = self.variance + variance
        self._move(error_ns / total)
        self._narrow(1 / total)

    def _move(self, weight: float) -> None:
        self.phase_ns += self.variance * weight
        self.period_ns += self._covariance * weight

    def _narrow(self, information: float) -> None:
        self.period_variance -= self._covariance * self._covariance * information
        self._covariance -= self.variance * self._covariance * information
        self.variance -= self.variance * self.variance * information


class SensorPhase(Phase):
    """That of a sensor's sampling clock. `phase_ns` is when the next sample comes to be."""

    __slots__ = ("_contradictions", "_deviation", "_nominal_ns", "_run", "log_noise")

    def __init__(self, period_ns: float) -> None:
        """`period_ns` is the nominal period."""
        super().__init__(
            0.0, period_ns, (_UNKNOWN * period_ns) ** 2, (_FIRST_ERROR * period_ns) ** 2,
            _JITTER_NS**2, (_DRIFT * period_ns) ** 2,
        )  # fmt: skip
        self._nominal_ns = period_ns
        self._deviation = _FIRST_ERROR
        # Logarithm of the factor by which its process noise exceeds a crystal's, as that of a program does.
        self.log_noise = 0.0
        self._run = 0.0  # negative log-likelihood of the reads since the last that was early
        self._contradictions = 0

    @property
    def period_error(self) -> float:
        """Relative deviation of the period from the nominal one."""
        return self.period_ns / self._nominal_ns - 1

    @property
    def is_steady(self) -> bool:
        """Whether the clock runs as a crystal does, and its period is known."""
        return not self.log_noise and self.period_variance < (_STEADY * self.period_ns) ** 2

    def begin(self, low_ns: float, high_ns: float) -> None:
        """The first sample came to be between these two; the next one is expected."""
        self.phase_ns = (low_ns + high_ns) / 2
        self.variance = (high_ns - low_ns) ** 2 / 12
        self._covariance = 0.0
        self.advance(1)

    def hold_over(self, steps: int) -> None:
        """See `Phase`; an unknown phase is within a period, whatever passes."""
        super().hold_over(steps)
        if self.variance > (most := (_UNKNOWN * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self.variance)
            self.variance = most
        if self.period_variance > (most := (_MOST_ERROR * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self.period_variance)
            self.period_variance = most

    def learn_bracket(self, low_ns: float, high_ns: float, variance: float) -> None:
        """While little is known: the sample came to be between these two, anywhere."""
        variance += (high_ns - low_ns) ** 2 / 12 + READ_VARIANCE
        error_ns = (low_ns + high_ns) / 2 - self.phase_ns
        if error_ns * error_ns > CONTRADICTS * CONTRADICTS * (self.variance + variance):
            if self._is_contradicted():
                self.phase_ns += error_ns
                self.variance = variance
            return
        self._contradictions = 0
        self.correct(error_ns, variance)

    def learn_bit(self, read_ns: float, variance: float, sign: int) -> None:
        """The sample had come to be at the PDI read (`sign` 1), or had not (-1)."""
        deviation_ns = math.sqrt(self.variance + variance + READ_VARIANCE)
        late = (read_ns - self.phase_ns) / deviation_ns
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
        slope = (1 - 2 * _WRONG) * sign * math.exp(-late * late / 2) / (_ROOT_2_PI * chance * deviation_ns)
        self._move(-slope)
        surprise = -math.log(chance)
        if sign > 0 and late > 0:
            # A late read bounds the phase on one side only: it pulls, but reduces no variance.
            self._run += surprise
            if self._run > _UNLIKELY_RUN:
                self.log_noise += _NOISE_STEP
        else:
            self._run = 0.0
            self._narrow(slope * slope + slope * late / deviation_ns)
        self._adapt_noise((1 - chance) * (surprise + math.log(1 - chance)))

    def learn_instant(self, instant_ns: float, variance: float) -> None:
        """The sample came to be then."""
        error_ns = instant_ns - self.phase_ns
        surprise = error_ns * error_ns / (self.variance + variance)
        if surprise > CONTRADICTS * CONTRADICTS:
            if self._is_contradicted():
                self._move(error_ns / self.variance)
            return
        self._contradictions = 0
        self.correct(error_ns, variance)
        self._adapt_noise((surprise - 1) / 2)

    def expect_noise(self, variance: float) -> None:
        """The instants have about this variance about those of a crystal."""
        self._adapt_noise(math.log(max(variance, _JITTER_NS**2) / _JITTER_NS**2) / _NOISE_GAIN)

    def _adapt_noise(self, excess: float) -> None:
        """A measurement was more surprising than the model expects, by `excess`."""
        log_noise = self.log_noise + _NOISE_GAIN * excess
        if log_noise > 0 or self.log_noise > 0:
            self.log_noise = min(max(log_noise, 0.0), _MOST_NOISE)
            self._phase_noise = math.exp(self.log_noise) * _JITTER_NS**2
            self._period_noise = math.exp(_NOISE_RATE * self.log_noise) * (_DRIFT * self._nominal_ns) ** 2

    def _move(self, weight: float) -> None:
        period_ns = self.period_ns
        super()._move(weight)
        if abs(self.period_ns - self._nominal_ns) > _LARGEST_ERROR * self._nominal_ns:
            self.period_ns = period_ns

    def _is_contradicted(self) -> bool:
        """A measurement did not fit; whether as many did that the phase is unknown from here on."""
        self._contradictions += 1
        if self._contradictions < _CONTRADICTIONS:
            return False
        self._contradictions = 0
        self._deviation = min(2 * self._deviation, _MOST_ERROR)
        self.variance = (_UNKNOWN * self.period_ns) ** 2
        self._covariance = 0.0
        self.period_variance = max(self.period_variance, (self._deviation * self.period_ns) ** 2)
        return True
