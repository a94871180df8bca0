"""Was the sensor stationary for the whole of a window, and what did it read meanwhile?

Judged by the standard deviation of every reading, by the drift of its mean within the window, and by the mean
angular rate. One bad sample spoils the window.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ft_compensation.quantities import ZERO, CompensationError, Wrench
from ft_compensation.stationary_limits import StationaryLimits
from protocol.framing import DataFlag
from protocol.pdo import Sample, Vector3
from protocol.sensor.warnings_register import WarningFlag

_MOST_SAMPLES: Final = 200_000
_BLOCKS: Final = 4
_DRIFT_ALLOWANCE: Final = 5.0
"""Means of blocks of noise rarely differ by more than this many of their standard errors."""
BAD_WRENCH: Final = (
    WarningFlag.FORCE_TORQUE_SATURATED | WarningFlag.ADC_OUT_OF_SYNC | WarningFlag.FORCE_TORQUE_OUT_OF_RANGE
)
"""Warnings with which force and torque must not be used."""


class NotStationaryError(CompensationError):
    """The sensor was not stationary: what moved, by how much, and the limit."""


class StationaryMeans(NamedTuple):
    """What the stationary sensor read: means over the window, and standard deviations of single samples."""

    wrench: Wrench
    """N, Nm"""
    acceleration: Vector3
    """m/s²; minus gravity in the sensor's frame"""
    angular_rate: Vector3
    """rad/s: the gyroscope's offset, if the sensor did not turn slowly"""
    force_spread: Vector3
    """N"""
    torque_spread: Vector3
    """Nm"""
    samples: int
    seconds: float
    acceleration_spread: Vector3 = ZERO
    """m/s²"""


class StationaryWindow:
    """Collects the samples of one window. `add` until it is true, then `means`."""

    def __init__(self, seconds: float = 1.0, limits: StationaryLimits | None = None) -> None:
        """The window lasts `seconds` of the samples' own time."""
        self.seconds = seconds
        self.limits = limits or StationaryLimits()
        self.spoiled: str | None = None
        self._rows: list[tuple[float, ...]] = []
        self._first_s: float | None = None
        self._last_s = 0.0

    @property
    def count(self) -> int:
        """Samples so far."""
        return len(self._rows)

    def add(self, sample: Sample, time_s: float, flags: int = 0) -> bool:
        """Take a sample of time `time_s` (s, any clock) with a frame's flags. True: the window is complete.

        A REPEATED frame is not a sample and is not counted. A bad sample completes the window at once.
        """
        if self._first_s is None:
            self._first_s = time_s
        if time_s < self._first_s and self.spoiled is None:
            self.spoiled = "the clock of the samples was set back"
        if self.spoiled is None:
            self.spoiled = _what_is_wrong(sample, flags)
            if self.spoiled is None and not flags & DataFlag.REPEATED:
                self._rows.append((*sample.force, *sample.torque, *sample.acceleration, *sample.angular_rate))
        self._last_s = time_s
        return (
            self.spoiled is not None
            or time_s - self._first_s >= self.seconds
            or len(self._rows) >= _MOST_SAMPLES
        )

    def means(self) -> StationaryMeans:
        """The means over the window; NotStationaryError if the sensor was not stationary throughout."""
        if self.spoiled is not None:
            raise NotStationaryError(f"the window is spoiled: {self.spoiled}")
        seconds = 0.0 if self._first_s is None else self._last_s - self._first_s
        if len(self._rows) < max(2, self.limits.least_samples):
            raise NotStationaryError(
                f"only {len(self._rows)} new samples came in {seconds:.2g} s, at least "
                f"{self.limits.least_samples} are needed"
            )
        return stationary_means(np.array(self._rows), seconds, self.limits)


class _Reading(NamedTuple):
    name: str
    columns: slice
    unit: str
    spread: str
    wander: str | None


_READINGS: Final = (
    _Reading("force", slice(0, 3), "N", "force_spread", "force_wander"),
    _Reading("torque", slice(3, 6), "Nm", "torque_spread", "torque_wander"),
    _Reading("acceleration", slice(6, 9), "m/s²", "acceleration_spread", "acceleration_wander"),
    _Reading("angular rate", slice(9, 12), "rad/s", "angular_rate_spread", None),
)


def stationary_means(rows: NDArray[np.float64], seconds: float, limits: StationaryLimits) -> StationaryMeans:
    """The means of `rows` (n, 12): force, torque, acceleration, angular rate.

    NotStationaryError if the sensor moved.
    """
    mean, spread = rows.mean(axis=0), rows.std(axis=0, ddof=1)
    if not rows[:, 6:].any():
        raise NotStationaryError(
            "the sensor's IMU reads only zeros, so it is unknown whether the sensor moves: switch the IMU on "
            "(imu_active)"
        )
    for reading in _READINGS:
        _check(rows[:, reading.columns], spread[reading.columns], reading, limits)
    rate = float(np.linalg.norm(mean[9:12]))
    if rate > limits.angular_rate:
        raise NotStationaryError(
            f"the sensor turns: its mean angular rate is {rate:.2g} rad/s, the limit is "
            f"{limits.angular_rate:g} rad/s"
        )
    return StationaryMeans(
        Wrench(_triple(mean[0:3]), _triple(mean[3:6])),
        _triple(mean[6:9]),
        _triple(mean[9:12]),
        _triple(spread[0:3]),
        _triple(spread[3:6]),
        len(rows),
        seconds,
        _triple(spread[6:9]),
    )


def _check(
    rows: NDArray[np.float64], spread: NDArray[np.float64], reading: _Reading, limits: StationaryLimits
) -> None:
    axis = int(spread.argmax())
    limit = getattr(limits, reading.spread)
    if spread[axis] > limit:
        raise NotStationaryError(
            f"the sensor is not stationary: {reading.name} {'xyz'[axis]} moved by {spread[axis]:.2g} "
            f"{reading.unit} (standard deviation), the limit is {limit:g} {reading.unit}"
        )
    if reading.wander is None or len(rows) < 2 * _BLOCKS:
        return
    limit = getattr(limits, reading.wander)
    blocks = np.array_split(rows, _BLOCKS)
    means = np.array([block.mean(axis=0) for block in blocks])
    # The noise within the blocks, which a drifting mean does not raise.
    noise = np.sqrt(np.mean([block.var(axis=0, ddof=1) for block in blocks], axis=0))
    excess = np.ptp(means, axis=0) - _DRIFT_ALLOWANCE * noise / math.sqrt(len(blocks[-1]))
    axis = int(excess.argmax())
    if excess[axis] > limit:
        raise NotStationaryError(
            f"the sensor is not stationary: {reading.name} {'xyz'[axis]} drifted by "
            f"{np.ptp(means, axis=0)[axis]:.2g} {reading.unit} within the window, the limit is "
            f"{limit:g} {reading.unit}"
        )


def _what_is_wrong(sample: Sample, flags: int) -> str | None:
    if flags & DataFlag.INVALID:
        return "the sensor did not answer the bus (a frame is marked INVALID)"
    if not sample.is_finite:
        return "a sample has numbers that are not finite"
    if sample.force_torque_saturated or sample.warnings & BAD_WRENCH:
        return "force or torque was saturated or out of range"
    if sample.acceleration_saturated or sample.angular_rate_saturated:
        return "the IMU was saturated"
    return None


def _triple(values: NDArray[np.float64]) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z
