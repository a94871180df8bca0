"""The sensor's own filters, which make what it measures late, with the response that is derived in
`bota_ethercat.sensor.response`.

A signal is a function of the time, s. The filters add up its values at some instants before the sample.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Final

from bota_ethercat.sensor.filters import ImuFilter
from bota_ethercat.sensor.response import FIR_TAPS, fir_taps

Signal = Callable[[float], Sequence[float]]
Past = Sequence[tuple[float, float]]  # instants, s before a sample, and their weights
_STEPS: Final = 4  # instants in a sample period
# The third-order sinc filter: three moving averages over a period, one after the other.
_SINC: Final = [
    (x * x / 2 if x < 1 else (3 - x) ** 2 / 2 if x > 2 else (6 - 2 * x) * x / 2 - 1.5) / _STEPS
    for x in ((n + 0.5) / _STEPS for n in range(3 * _STEPS))
]
# Gauss-Laguerre: for a signal that is slow, the mean over the past of a first-order low-pass filter.
_EXPONENTIAL: Final = (
    (0.4157745568, 0.7110930099),
    (2.2942803603, 0.2785177336),
    (6.2899450829, 0.0103892565),
)


def weighted(weights: Sequence[float], vectors: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """The sum of vectors times weights."""
    return tuple(sum(map(operator.mul, weights, axis)) for axis in zip(*vectors, strict=True))


class LoadFilter:
    """Of force and torque: `signal` through the sinc filter, `noise` added, and through the FIR filter."""

    def __init__(
        self, signal: Signal, noise: Callable[[], Sequence[float]], period_s: float, *, fir: bool
    ) -> None:
        self._signal, self._noise, self._period_s = signal, noise, period_s
        self._taps = fir_taps() if fir else (1.0,)
        self._begin_s = 0.0  # time of sample 0
        remember = functools.lru_cache(2 * FIR_TAPS)  # what following samples need too
        self._values, self._sinc = remember(self._before), remember(self._add_up)

    def at(self, number: int, seconds: float) -> tuple[float, ...]:
        """N, Nm: of sample `number`, at this time."""
        self._begin_s = seconds - number * self._period_s
        return weighted(self._taps, [self._sinc(number - n) for n in range(len(self._taps))])

    def _add_up(self, number: int) -> tuple[float, ...]:
        values = [value for n in range(3) for value in self._values(number - n)]
        return tuple(map(operator.add, weighted(_SINC, values), self._noise()))

    def _before(self, number: int) -> list[Sequence[float]]:
        end_s, step_s = self._begin_s + number * self._period_s, self._period_s / _STEPS
        return [self._signal(end_s - (n + 0.5) * step_s) for n in range(_STEPS)]


def imu_filter(row: ImuFilter) -> Past:
    """Of accelerometer or gyroscope: a first-order low-pass filter, and the rest of the table's delay."""
    constant_s = 1 / (math.tau * row.bandwidth_hz)
    rest_s = row.delay_ms * 1e-3 - constant_s
    return [(rest_s + constant_s * x, weight) for x, weight in _EXPONENTIAL]


def filtered(signal: Signal, past: Past, seconds: float) -> tuple[float, ...]:
    """The signal as it is measured at this time."""
    return weighted([weight for _, weight in past], [signal(seconds - s) for s, _ in past])
