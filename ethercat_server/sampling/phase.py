"""The one filter of offset and rate: of a sensor's sampling clock, and of a slave controller's local clock.

A clock counts steps: a sensor's samples, or the ns of a slave controller's local time. The filter (Kalman,
for single bits assumed-density) estimates when a step happens and how long steps are; docs/sample-clock.md
has the formulas. Process noise is what a crystal does, until measurements are more surprising than that.
"""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.sampling.constants import (
    CERTAIN,
    CONTRADICTS,
    DRIFT,
    IN_A_ROW,
    JITTER_NS,
    KNOWN_ERROR,
    LARGEST_ERROR,
    PERIOD_ERROR,
    QUICK_GAIN,
    RESOLUTION_NS,
    UNLIKELY_RUN,
    WRONG_BIT,
)

_ROOT_2_PI: Final = math.sqrt(2 * math.pi)
_ROOT_HALF: Final = math.sqrt(0.5)
_UNKNOWN: Final = math.sqrt(1 / 12)  # standard deviation of an unknown phase, in periods


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
        self._shift(error_ns / total)
        self._reduce_variance(1 / total)

    def _shift(self, weight: float) -> None:
        self.phase_ns += self.variance * weight
        self.period_ns += self._covariance * weight

    def _reduce_variance(self, information: float) -> None:
        self.period_variance -= self._covariance * self._covariance * information
        self._covariance -= self.variance * self._covariance * information
        self.variance -= self.variance * self.variance * information


class SensorPhase(Phase):
    """Phase of a sensor's sampling clock: `phase_ns` is the instant of the next sample."""

    __slots__ = ("_contradictions", "_deviation", "_most_noise", "_nominal_ns", "_run", "log_noise")

    def __init__(self, period_ns: float) -> None:
        """`period_ns` is the nominal period."""
        super().__init__(
            0.0, period_ns, (_UNKNOWN * period_ns) ** 2, (PERIOD_ERROR * period_ns) ** 2,
            JITTER_NS**2, (DRIFT * period_ns) ** 2,
        )  # fmt: skip
        self._nominal_ns = period_ns
        self._most_noise = math.log((_UNKNOWN * period_ns) ** 2 / (JITTER_NS**2))
        self._deviation = PERIOD_ERROR
        # Logarithm of the factor by which the process noise exceeds a crystal's: a program's, for example.
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
        return not self.log_noise and self.period_variance < (KNOWN_ERROR * self.period_ns) ** 2

    def begin(self, low_ns: float, high_ns: float) -> None:
        """The first sample was made between these two; the next one is expected."""
        self.phase_ns = (low_ns + high_ns) / 2
        self.variance = (high_ns - low_ns) ** 2 / 12
        self._covariance = 0.0
        self.advance(1)

    def hold_over(self, steps: int) -> None:
        """See `Phase`; the variance of the phase is at most that of an unknown one, within a period."""
        super().hold_over(steps)
        if self.variance > (most := (_UNKNOWN * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self.variance)
            self.variance = most
        if self.period_variance > (most := (LARGEST_ERROR * self.period_ns) ** 2):
            self._covariance *= math.sqrt(most / self.period_variance)
            self.period_variance = most

    def learn_bracket(self, low_ns: float, high_ns: float, variance: float) -> None:
        """While little is known: the sample was made between these two, uniformly distributed."""
        variance += (high_ns - low_ns) ** 2 / 12 + RESOLUTION_NS**2
        error_ns = (low_ns + high_ns) / 2 - self.phase_ns
        if error_ns * error_ns > CONTRADICTS * CONTRADICTS * (self.variance + variance):
            if self._is_contradicted():
                self.phase_ns += error_ns
                self.variance = variance
            return
        self._contradictions = 0
        self.correct(error_ns, variance)

    def learn_bit(self, read_ns: float, variance: float, sign: int) -> None:
        """The sample was there at the PDI read (`sign` 1), or was not (-1)."""
        deviation_ns = math.sqrt(self.variance + variance + RESOLUTION_NS**2)
        late = (read_ns - self.phase_ns) / deviation_ns
        if sign * late > CERTAIN:
            return
        if sign * late < -CONTRADICTS:
            if self._is_contradicted():
                return
        elif sign > 0:
            self._contradictions = 0
        chance = WRONG_BIT + (0.5 - WRONG_BIT) * math.erfc(-sign * late * _ROOT_HALF)
        slope = (1 - 2 * WRONG_BIT) * sign * math.exp(-late * late / 2) / (_ROOT_2_PI * chance * deviation_ns)
        self._shift(-slope)
        surprise = -math.log(chance)
        if sign > 0 and late > 0:
            # A late read bounds the phase on one side only: it shifts the phase, but reduces no variance.
            self._run += surprise
            if self._run > UNLIKELY_RUN:
                self.log_noise += QUICK_GAIN * self._run
        else:
            self._run = 0.0
            self._reduce_variance(slope * slope + slope * late / deviation_ns)
        self._adapt_noise((1 - chance) * (surprise + math.log(1 - chance)))

    def learn_instant(self, instant_ns: float, variance: float) -> None:
        """An event says when the sample was made."""
        error_ns = instant_ns - self.phase_ns
        surprise = error_ns * error_ns / (self.variance + variance)
        if surprise > CONTRADICTS * CONTRADICTS:
            if self._is_contradicted():
                self._shift(error_ns / self.variance)
            return
        self._contradictions = 0
        self.correct(error_ns, variance)
        self._adapt_noise((surprise - 1) / 2)

    def expect_noise(self, variance: float) -> None:
        """Raise the process noise: samples deviate from a crystal by about this variance."""
        self._adapt_noise(math.log(max(variance / JITTER_NS**2, 1.0)) / QUICK_GAIN)

    def _adapt_noise(self, excess: float) -> None:
        """A measurement was more surprising than the model expects, by `excess`."""
        log_noise = self.log_noise + QUICK_GAIN * excess
        if log_noise > 0 or self.log_noise > 0:
            self.log_noise = min(max(log_noise, 0.0), self._most_noise)
            self._phase_noise = math.exp(self.log_noise) * JITTER_NS**2
            self._period_noise = math.exp(self.log_noise) * (DRIFT * self._nominal_ns) ** 2

    def _shift(self, weight: float) -> None:
        period_ns = self.period_ns
        super()._shift(weight)
        if abs(self.period_ns - self._nominal_ns) > CERTAIN * LARGEST_ERROR * self._nominal_ns:
            self.period_ns = period_ns

    def _is_contradicted(self) -> bool:
        """A measurement did not fit; whether as many did that the phase is unknown from here on."""
        self._contradictions += 1
        if self._contradictions < IN_A_ROW:
            return False
        self._contradictions = 0
        self._deviation = min(2 * self._deviation, LARGEST_ERROR)
        self.variance = (_UNKNOWN * self.period_ns) ** 2
        self._covariance = 0.0
        self.period_variance = max(self.period_variance, (self._deviation * self.period_ns) ** 2)
        return True
