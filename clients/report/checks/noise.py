"""Noise of each channel compared with a healthy sensor, although the sensor may move and touch things.

The samples are divided into windows of half a second (at least 32 samples). A cubic is fitted to each and
subtracted, which removes slow motion and drift; the residual, by its degrees of freedom, gives the standard
deviation of the window. The noise is the median over the calmer half of the windows, by the range of the
cubics of force and torque, which excludes contacts and quick motion. If the accelerometer shows that the
sensor was shaken even then, vibration cannot be told from noise and nothing is judged.

A median misses intermittent noise. So every window is also judged by its second differences, which motion and
contacts hardly affect. Windows in which the accelerometer was shaken do not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from clients.numbers import figure, listing
from clients.report.checks.channels import ACCELERATION, ANGULAR_RATE, CHANNELS, Channel, noise_limit
from clients.report.checks.check import Check
from clients.report.subjects.series import Bools, Floats, Ints, Series
from protocol.health.verdict import Level

WINDOW_S: Final = 0.5
FEWEST_SAMPLES: Final = 32
"""Minimum number of samples in a window."""
ORDER: Final = 3
FEWEST_WINDOWS: Final = 8
"""Minimum number of windows to judge by."""
_NOISY: Final = 1.5
"""A window above this multiple of the limit is noisy; one of few samples needs more, to allow for chance."""
_VERY_NOISY: Final = 4.0
_FEWEST_NOISY: Final = 2  # windows: one may be a knock
_TO_DEVIATION: Final = 1.4826 / math.sqrt(6)
"""Makes the median size of second differences of white noise its standard deviation."""
_FILLED: Final = 0.8
"""Minimum share of its samples that a window must have."""
_UNEVEN: Final = 4.0
"""An IMU axis above this multiple of the noise of the other two is reported."""
_UNEVEN_FLOOR: Final = {ACCELERATION.name: 0.02, ANGULAR_RATE.name: 0.0035}
"""m/s² and rad/s below which it does not matter."""
NAME: Final = "Noise of force and torque"
IMU_NAME: Final = "Noise of the IMU"


@dataclass(frozen=True)
class Noise:
    """What was measured."""

    deviation: Floats
    """(12,) standard deviation; NaN if unknown."""
    limit: Floats
    """(12,) of a healthy sensor; NaN if unknown."""
    windows: int
    """Number of windows."""
    calm: int
    """Number of windows used."""
    window_s: float
    noisy: Ints
    """(12,) windows that are clearly above the limit, of all."""
    worst: Floats
    """(12,) standard deviation in the worst of these."""

    @property
    def shaken(self) -> bool:
        """Whether the sensor was shaken, even in the calm windows."""
        return bool(_shaken(self.deviation, self.limit))


def measure(series: Series) -> Noise:
    """The noise of all channels."""
    length = max(WINDOW_S, FEWEST_SAMPLES * series.period)
    limits = np.array([_limit(series, channel) for channel in CHANNELS])
    usable = series.finite & ~series.saturated
    number = np.floor(series.time / length).astype(np.int64)
    # A clock that jumps back must not join samples that are far apart.
    edges = np.flatnonzero(np.diff(number) != 0) + 1
    starts, ends = np.concatenate(([0], edges)), np.concatenate((edges, [series.count]))
    fewest = max(FEWEST_SAMPLES // 2, int(_FILLED * length / series.period))
    deviations, ranges, roughs, sizes = [], [], [], []
    for start, end in zip(starts, ends, strict=True):
        if end - start < fewest:
            continue
        values = series.values[start:end]
        good = np.asarray(usable[start:end].all(axis=0))
        deviation, reach = _window(series.time[start:end], values, good)
        deviations.append(deviation)
        ranges.append(reach)
        roughs.append(_rough(values, good))
        sizes.append(end - start)
    if len(deviations) < FEWEST_WINDOWS:
        unknown = np.full(len(CHANNELS), np.nan)
        return Noise(unknown, limits, len(deviations), 0, length, np.zeros(len(CHANNELS), np.int64), unknown)
    all_deviations, reaches = np.array(deviations), np.array(ranges)[:, :6]
    # A window in which a channel is unusable counts as the least calm.
    reaches = np.where(np.isfinite(reaches), reaches, np.inf)
    usual = np.median(reaches, axis=0)
    known = (usual > 0) & np.isfinite(usual)
    unrest = (reaches[:, known] / usual[known]).max(axis=1) if known.any() else np.zeros(len(reaches))
    calm = np.argsort(unrest, kind="stable")[: max(FEWEST_WINDOWS, len(unrest) // 2)]
    kept = all_deviations[calm]
    measured = np.sum(np.isfinite(kept), axis=0) >= FEWEST_WINDOWS // 2
    deviation = np.full(len(CHANNELS), np.nan)
    deviation[measured] = np.nanmedian(kept[:, measured], axis=0)
    rough = np.where(_shaken(all_deviations, limits)[:, None], np.nan, np.array(roughs))
    noisy = rough > limits * np.maximum(_NOISY, 1 + 5 / np.sqrt(sizes))[:, None]
    worst = np.where(noisy, rough, 0.0).max(axis=0)
    return Noise(deviation, limits, len(deviations), len(calm), length, noisy.sum(axis=0), worst)


def _shaken(deviation: Floats, limit: Floats) -> Bools:
    """Whether at least two axes of the accelerometer are above their limit: that is motion."""
    shaken: Bools = np.sum(deviation[..., 6:9] > limit[6:9], axis=-1) >= 2
    return shaken


def _limit(series: Series, channel: Channel) -> float:
    length = series.subject.sinc_length
    if channel.group.is_imu:
        return float("nan") if series.imu_off else noise_limit(channel, 0)
    if length is None or not series.subject.settings.get("calibration_matrix", False):
        return float("nan")
    return noise_limit(channel, length)


def _rough(values: Floats, good: Bools) -> Floats:
    """Standard deviation of each channel as its second differences tell it."""
    rough = np.full(values.shape[1], np.nan)
    rough[good] = np.median(np.abs(np.diff(values[:, good], 2, axis=0)), axis=0) * _TO_DEVIATION
    return rough


def _window(time: Floats, values: Floats, good: Bools) -> tuple[Floats, Floats]:
    """Standard deviation of each channel about its cubic, and how far the cubic ranges."""
    middle, half = (time[0] + time[-1]) / 2, max((time[-1] - time[0]) / 2, 1e-12)
    basis = np.polynomial.legendre.legvander((time - middle) / half, ORDER)
    deviation = np.full(values.shape[1], np.nan)
    reach = np.full(values.shape[1], np.nan)
    fit, *_ = np.linalg.lstsq(basis, values[:, good], rcond=None)
    trend = basis @ fit
    rest = values[:, good] - trend
    deviation[good] = np.sqrt(np.sum(rest**2, axis=0) / (len(time) - ORDER - 1))
    reach[good] = np.ptp(trend, axis=0)
    # A constant value has no noise; the fit leaves rounding errors.
    deviation[good & (values == values[0]).all(axis=0)] = 0.0
    return deviation, reach


def check_force_torque(series: Series, noise: Noise) -> Check:
    """Is the noise of force and torque that of a healthy sensor?"""
    settings = series.subject.settings
    if series.subject.sinc_length is None:
        return _not_possible(
            NAME, "The SINC length is not known, so no limit is known.", "Record the settings too."
        )
    if not settings.get("calibration_matrix", False):
        return _not_possible(
            NAME,
            "Force and torque are raw counts (the calibration matrix is off), and the "
            "limits are in N and Nm.",
            "Enable calibration_matrix and record again.",
        )
    return _judge(NAME, noise, range(6), "Small forces are hidden by it, and a controller reacts to it.",
                  "Record again with the sensor stationary and unloaded. If it persists, check cable, "
                  "shield and supply, then contact the manufacturer.")  # fmt: skip


def check_imu(series: Series, noise: Noise) -> Check:
    """Is the noise of the IMU that of a healthy sensor?"""
    if series.imu_off:
        return Check(IMU_NAME, Level.NOT_APPLICABLE, "The IMU is off.")
    found = _judge(
        IMU_NAME, noise, range(6, 12), "Gravity compensation and the like become noisy.",
        "Record again with the sensor stationary. If it persists, contact the manufacturer.",
    )  # fmt: skip
    if found.level is not Level.GOOD:
        return found
    uneven = [text for group in (ACCELERATION, ANGULAR_RATE) for text in _uneven(group.name, noise)]
    if uneven:
        return Check(
            IMU_NAME, Level.LOOK, f"{listing(uneven)}. That is below the limit.",
            "Three axes of one chip should be alike, unless the sensor vibrates about one axis.",
            "Record again with the sensor stationary. If it persists, contact the manufacturer.",
        )  # fmt: skip
    return found


def _uneven(group: str, noise: Noise) -> list[str]:
    indices = [index for index, channel in enumerate(CHANNELS) if channel.group.name == group]
    for index in indices:
        others = float(np.median([noise.deviation[other] for other in indices if other != index]))
        own = float(noise.deviation[index])
        if own > _UNEVEN_FLOOR[group] and own > _UNEVEN * others > 0:
            channel = CHANNELS[index]
            return [f"{channel.title} has {figure(own / others, 2)} times the noise of the other two axes "
                    f"({figure(own)} {channel.group.unit})"]  # fmt: skip
    return []


def _not_possible(name: str, why: str, remedy: str) -> Check:
    return Check(name, Level.NOT_POSSIBLE, why, "", remedy)


def _judge(name: str, noise: Noise, indices: range, matters: str, remedy: str) -> Check:
    if noise.calm == 0:
        return _not_possible(
            name, f"Only {noise.windows} windows of {figure(noise.window_s, 2)} s could be used; "
            f"{FEWEST_WINDOWS} are needed.", "Record for at least 10 s without interruption.",
        )  # fmt: skip
    ratio = noise.deviation / noise.limit
    unknown = [CHANNELS[index].title for index in indices if not np.isfinite(ratio[index])]
    above = [index for index in indices if ratio[index] > 1]
    if above and noise.shaken:
        return _not_possible(
            name, "The sensor was shaken all the time (the accelerometer shows it), so noise cannot "
            "be told from vibration.", "Record again with the sensor stationary.",
        )  # fmt: skip
    if above:
        texts = [
            f"{CHANNELS[p].title} has a noise of {figure(noise.deviation[p])} {CHANNELS[p].group.unit}, "
            f"{figure(ratio[p], 2)} times the limit of {figure(noise.limit[p])}"
            for p in above
        ]
        return Check(name, Level.TROUBLE, f"{listing(texts)}.", matters, remedy)
    noisy = [index for index in indices if noise.noisy[index] >= _FEWEST_NOISY]
    if noisy:
        times = noise.worst / noise.limit
        texts = [
            f"{CHANNELS[p].title} is noisy in {noise.noisy[p]} of {noise.windows} windows of "
            f"{figure(noise.window_s, 2)} s, at worst {figure(noise.worst[p])} {CHANNELS[p].group.unit}, "
            f"{figure(times[p], 2)} times the limit of {figure(noise.limit[p])}"
            for p in noisy
        ]
        level = Level.TROUBLE if max(times[noisy]) > _VERY_NOISY else Level.LOOK
        return Check(name, level, f"{listing(texts)}.", matters, remedy)
    if unknown:
        return _not_possible(
            name, f"It could not be measured for {listing(unknown)}: too often saturated or not a number.",
            "Fix that first, then record again.",
        )  # fmt: skip
    worst = max(indices, key=lambda index: float(ratio[index]))
    return Check(
        name, Level.GOOD, f"At most {figure(100 * ratio[worst], 2)} % of a healthy sensor's limit "
        f"({CHANNELS[worst].title}: {figure(noise.deviation[worst])} {CHANNELS[worst].group.unit}).",
    )  # fmt: skip
