"""What the sensor feels, and what it measures of that: through its filters, with its noise."""

from __future__ import annotations

import bisect
import functools
import math
import operator
import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.sensor.filters import ACCELERATION_FILTERS, ANGULAR_RATE_FILTERS, ImuFilter
from bota_ethercat.sensor.response import FIR_TAPS, fir_taps, healthy_noise
from bota_ethercat.settings import BASE_SAMPLING_RATE_HZ, SettingValue
from bota_ethercat.world import REST, Felt
from ethercat_server.virtual_sensor.options import FAULT, ZERO
from ethercat_server.virtual_sensor.signals import PhysicalSample, World, quaternion

LOST_AFTER_S: Final = 0.1  # also by how much a time stamp may differ from the time
_REMEMBERED: Final = 4096  # moments, of which the filters look at the last second at most

_FILTERS: Final = ("fir", "acceleration_filter", "angular_rate_filter")
_ACCELERATION_NOISE, _ANGULAR_RATE_NOISE = 0.002, 0.04  # g, °/s


class ExternalWorld:
    """A world outside, moment by moment; each holds until the next. At rest before the first."""

    def __init__(self, lost: str = FAULT) -> None:
        self._lost = lost
        self._moments = deque([(-math.inf, REST)], maxlen=_REMEMBERED)
        self.counts = {"taken": 0, "refused": 0}  # moments

    def update(self, time_s: float, felt: Felt, now_s: float) -> None:
        """A moment later than the one before; any other, or one far from now, is refused."""
        is_good = time_s > self._moments[-1][0] and abs(time_s - now_s) <= LOST_AFTER_S
        self.counts["taken" if is_good else "refused"] += 1
        if is_good:
            self._moments.append((time_s, felt))

    def is_faulty(self, now_s: float) -> bool:
        """Whether it has stopped, and the sensor gives nothing new therefore."""
        return self._lost == FAULT and LOST_AFTER_S < now_s - self._moments[-1][0] < math.inf

    def __call__(self, seconds: float) -> Felt:
        at = bisect.bisect_right(self._moments, seconds, key=operator.itemgetter(0))
        begin_s, felt = self._moments[max(0, at - 1)]
        return REST if self._lost == ZERO and seconds - begin_s > LOST_AFTER_S else felt


# The sensor's own filters make what it measures late, with the response that is derived in
# `bota_ethercat.sensor.response`: they add up a signal's values at some instants before the sample.
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


class Measured:
    """A world as the sensor measures it, once it has filters."""

    def __init__(self, world: World, seed: int, noise: bool) -> None:
        self._world, self._noise = world, noise
        self._gauss = random.Random(seed).gauss
        self._settings: tuple[SettingValue, ...] = ()  # of the filters

    def set_filters(self, sinc_length: int, settings: Mapping[str, SettingValue]) -> None:
        wanted = sinc_length, *(settings[name] for name in _FILTERS)
        if wanted == self._settings:
            return
        self._settings = wanted
        self.deviations = healthy_noise(sinc_length)
        _, fir, acceleration, rate = wanted
        period_s = sinc_length / BASE_SAMPLING_RATE_HZ
        self._load_filter = LoadFilter(
            lambda seconds: self._world(seconds).wrench, self._load_noise, period_s, fir=bool(fir)
        )
        self._acceleration_filter = imu_filter(ACCELERATION_FILTERS[acceleration])
        self._rate_filter = imu_filter(ANGULAR_RATE_FILTERS[rate])

    def _load_noise(self) -> list[float]:
        return [self._gauss(0.0, deviation) if self._noise else 0.0 for deviation in self.deviations]

    def reading(self, number: int, instant: int, seconds: float) -> PhysicalSample:  # noqa: ARG002
        world = self._world
        felt = world(seconds)
        load = self._load_filter.at(number, seconds)
        acceleration = filtered(lambda t: world(t).acceleration, self._acceleration_filter, seconds)
        rate = filtered(lambda t: world(t).angular_rate, self._rate_filter, seconds)
        values = [*load, *(a / STANDARD_GRAVITY for a in acceleration), *map(math.degrees, rate)]
        if self._noise:
            for axis in range(6, 9):
                values[axis] += self._gauss(0.0, _ACCELERATION_NOISE)
                values[axis + 3] += self._gauss(0.0, _ANGULAR_RATE_NOISE)
        orientation = (0.0, 0.0, 0.0, 0.0) if felt.attitude is None else quaternion(felt.attitude)
        return PhysicalSample(values, felt.temperature, orientation)
