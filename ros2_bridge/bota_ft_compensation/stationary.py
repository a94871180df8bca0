# SPDX-License-Identifier: Apache-2.0
"""Was the sensor stationary for the whole of a window, and what did it read meanwhile?

The criterion of the node's tare and of identification (docs/compensation.md). Standard deviations
see what shakes or is touched, drift a cable that settles or a robot that creeps, the mean angular
rate a turn about the vertical. One bad sample spoils the window. The server's own tare has another
criterion, by the same limits: it knows no IMU's calibration.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.pdo import Sample, Vector3
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE, judge
from bota_ft_compensation.quantities import (
    NO_WRENCH,
    ZERO,
    CompensationError,
    Wrench,
)

_MOST_SAMPLES: Final = 200_000
_BLOCKS: Final = 4
_ALIKE: Final = 25  # samples: as many last the filters of force and torque
CHANCE: Final = 5.0  # standard errors: means of noise rarely differ by more
_NO_LIMIT: Final = 1e-12
_NAMES: Final = ("force", "torque", "acceleration", "angular rate")
_UNITS: Final = ("N", "Nm", "m/s²", "rad/s")
Array = NDArray[np.float64]


class NotStationaryError(CompensationError):
    """The sensor was not stationary: what moved, by how much, and the limit."""


class StationaryMeans(NamedTuple):
    """What the stationary sensor read: means over the window, and standard deviations of single samples."""

    wrench: Wrench  # N, Nm
    acceleration: Vector3  # m/s²; minus gravity in the sensor's frame
    force_spread: Vector3  # N
    torque_spread: Vector3  # Nm
    samples: int
    acceleration_spread: Vector3 = ZERO  # m/s²
    time_s: float | None = None  # of its middle, by the samples' clock
    latest: Wrench = NO_WRENCH  # N, Nm: the mean of the last quarter
    # Variance of means of force and torque, against that of as many samples that filters do not make alike.
    alike: float = 1.0

    @property
    def noise(self) -> tuple[float, ...]:
        """Deviations of force, N, and torque, Nm, of a sample from which the mean is subtracted."""
        # Of the variance: that of the mean, which the window lacks, and 1.5 times that, as few samples leave
        # unknown how large it is (Student's t).
        share = min(self.alike / self.samples, 0.5)
        wider = math.sqrt((1.0 + 2.5 * share) / (1.0 - share))
        return tuple(wider * each for each in self.force_spread + self.torque_spread)


class StationaryWindow:
    """Collects the samples of one window. `add` until it is true, then `means`."""

    def __init__(self, seconds: float = 1.0, limits: StationaryLimits | None = None) -> None:
        """It lasts `seconds` of the samples' own time, longer while they are fewer than `least_samples`."""
        self.seconds = seconds
        self.limits = limits or StationaryLimits()
        self.spoiled: str | None = None
        self._rows: list[tuple[float, ...]] = []
        self._first_s: float | None = None
        self._last_s = 0.0

    @property
    def count(self) -> int:
        return len(self._rows)

    def add(self, sample: Sample, time_s: float) -> bool:
        """Take a new sample of time `time_s` (s, any clock). True: the window is complete.

        A bad sample completes it at once.
        """
        if self._first_s is None:
            self._first_s = time_s
        if self.spoiled is None:
            is_back = time_s < self._first_s
            self.spoiled = "the clock of the samples was set back" if is_back else _what_is_wrong(sample)
        if self.spoiled is not None:
            return True
        self._last_s = time_s
        self._rows.append((*sample.force, *sample.torque, *sample.acceleration, *sample.angular_rate))
        lasted = time_s - self._first_s >= self.seconds and self.count >= self.limits.least_samples
        return lasted or self.count >= _MOST_SAMPLES

    def means(self) -> StationaryMeans:
        """The means over the window; NotStationaryError if the sensor was not stationary throughout."""
        if self.spoiled is not None:
            raise NotStationaryError(f"the window is spoiled: {self.spoiled}")
        seconds = self._last_s - (self._first_s or 0.0)
        if self.count < max(2, self.limits.least_samples):
            raise NotStationaryError(
                f"only {self.count} new samples came in {seconds:.2g} s, at least "
                f"{self.limits.least_samples} are needed"
            )
        means = stationary_means(np.array(self._rows), self.limits)
        return means._replace(time_s=self._last_s - 0.5 * seconds)


def stationary_means(rows: Array, limits: StationaryLimits) -> StationaryMeans:
    """The means of `rows` (n, 12): force, torque, acceleration, angular rate.

    NotStationaryError if the sensor moved.
    """
    mean, spread = rows.mean(axis=0), rows.std(axis=0, ddof=1)
    if not rows[:, 6:].any():
        raise NotStationaryError(
            "the sensor's IMU reads only zeros, so it is unknown whether the sensor moves: switch the IMU on "
            "(imu_active)"
        )
    _check(spread, limits.deviations, spread, "moved by {} (standard deviation)")
    if len(rows) >= 2 * _BLOCKS:
        blocks = [block[:, :9] for block in np.array_split(rows, _BLOCKS)]
        drift = np.ptp([block.mean(axis=0) for block in blocks], axis=0)
        # The noise within the blocks, which a drifting mean does not raise.
        noise = np.sqrt(np.mean([block.var(axis=0, ddof=1) for block in blocks], axis=0))
        excess = drift - CHANCE * noise / math.sqrt(len(blocks[-1]))
        _check(excess, limits.drifts, drift, "drifted by {} within the window")
    rate = float(np.linalg.norm(mean[9:12]))
    if rate > limits.angular_rate:
        raise NotStationaryError(
            f"the sensor turns: its mean angular rate is {rate:.2g} rad/s, the limit is "
            f"{limits.angular_rate:g} rad/s"
        )
    f, t, a = (triple(mean[first : first + 3]) for first in (0, 3, 6))
    of_force, of_torque, of_acceleration = (triple(spread[first : first + 3]) for first in (0, 3, 6))
    latest = Wrench.of(rows[-len(rows) // _BLOCKS :, :6].mean(axis=0))
    noise = (rows[:, :6] - mean[:6]) / (spread[:6] + _NO_LIMIT)
    lags = range(1, min(_ALIKE, len(rows) // 4 + 1))
    pairs = sum(float((noise[by:] * noise[:-by]).sum()) for by in lags) / noise.size
    # Noise less its own mean lacks some of that at every lag.
    alike = max(1.0, (1.0 + 2.0 * pairs) / (1.0 - (2.0 * len(lags) + 1.0) / len(rows)))
    return StationaryMeans(
        Wrench(f, t), a, of_force, of_torque, len(rows), of_acceleration, latest=latest, alike=alike
    )


def _check(values: Array, limits: tuple[float, ...], shown: Array, how: str) -> None:
    """NotStationaryError, with `how` and what is `shown`, if the axis nearest to its limit is beyond it."""
    axis = int((values / np.maximum(limits, _NO_LIMIT)).argmax())
    if values[axis] > limits[axis]:
        name, unit = f"{_NAMES[axis // 3]} {'xyz'[axis % 3]}", _UNITS[axis // 3]
        raise NotStationaryError(
            f"the sensor is not stationary: {name} {how.format(f'{shown[axis]:.2g} {unit}')}, the limit is "
            f"{limits[axis]:g} {unit}"
        )


def _what_is_wrong(sample: Sample) -> str | None:
    if not sample.is_finite:
        return "a sample has numbers that are not finite"
    return judge(sample, (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE))[1] or None


def triple(values: Array) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z
