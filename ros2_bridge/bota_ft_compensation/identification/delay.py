# SPDX-License-Identifier: Apache-2.0
"""How much later force and torque are than the accelerometer, in a recording of a sensor that was shaken.

Nothing touches the tool, so the force is a linear function of what the IMU felt some time before: of the
specific force, the angular acceleration and the products of the angular rates. The lag with the least sum of
squares is taken: the axes of the two need not be the same, nor their gains exact, and a trend of the bias is
taken out first. Its interval is the wider of two: that of the lags of eight parts of the recording, which
covers what the model leaves out (a cable, a tool that bends), and what the residuals' noise gives. A lag is
worth nothing unless compensation by it leaves less force in parts of the recording that did not choose it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.settings import SettingValue
from bota_ft_compensation.alignment import Alignment, align
from bota_ft_compensation.identification.resampling import (
    Array,
    at_times,
    hann_window,
    resampled,
    smoothed,
)
from bota_ft_compensation.quantities import CompensationError

_PARTS: Final = 8
_T_95: Final = 2.365  # Student's t for as many parts
_EARLIEST_S, _LATEST_S = -0.1, 0.2
# Motion must explain so much of the force's variance, and the interval be so narrow: else nothing was shown.
_EXPLAINED: Final = 0.5
_WIDEST_S: Final = 0.005
_LEAST_S: Final = 4.0
_SHORTEST_S, _LONGEST_S = 0.04, 0.5  # of the window that smooths
_TREND: Final = 3  # coefficients of the polynomial that the bias may follow
_AS_GOOD: Final = 1.05  # noise alone makes them differ so much, where there is little to align
_LEFT: Final = 0.7  # of the force's rms: more is no model of it
_SMOOTHED: Final = 1.0  # times the ratio of the force's motion to its rate of change


class Lag(NamedTuple):
    seconds: float  # by which force and torque come later than the accelerometer; negative: earlier
    interval_s: float  # 95 % interval: plus and minus
    explained: float  # part of the force's variance that the motion explains, 0 to 1


def find_lag(times: Array, force: Array, acceleration: Array, rate: Array, gyroscope_s: float = 0.0) -> Lag:
    """From samples, (n,) s and (n, 3) N, m/s² and rad/s; CompensationError if they do not show it.

    `gyroscope_s`: by how much the gyroscope is later than the accelerometer.
    """
    if not (np.diff(times) > 0).all():
        raise CompensationError("the samples are not in the order of their times: record from one server")
    # On even grids, so that stamps that jitter do not shake the derivative of the angular rate.
    samples = np.concatenate([force, acceleration, rate], axis=1)
    period, parts = _stretches(times, samples, _LATEST_S - _EARLIEST_S + 2 * _SHORTEST_S)
    # All alike, and so long that little noise remains in what the motion is regressed on: that would pull the
    # lag. Noise would be least, and fit best, between two samples, too.
    window = hann_window(_SHORTEST_S, period)
    slows = [smoothed(columns[:, :3], window) for _, columns in parts]
    slow, paces = map(np.concatenate, (slows, [np.gradient(each, period, axis=0) for each in slows]))
    pace = float(np.linalg.norm(slow - slow.mean(axis=0)) / np.linalg.norm(paces))
    seconds = min(max(_SMOOTHED * pace, _SHORTEST_S), _LONGEST_S)
    period, parts = _stretches(times, samples, _LATEST_S - _EARLIEST_S + 2 * seconds)
    window, smooth, inner = hann_window(seconds, period), list[Array](), list[Array]()
    for grid, columns in parts:
        rate = columns[:, 6:]
        spun = np.concatenate([columns[:, :6], np.gradient(rate, period, axis=0), _products(rate)], axis=1)
        smooth.append(smoothed(spun, window))
        inner.append(np.arange(grid[0] + _LATEST_S + seconds, grid[-1] + _EARLIEST_S - seconds, seconds / 4))
    instants, times = np.concatenate(inner), np.concatenate([grid for grid, _ in parts])
    force, acceleration, turned = np.split(np.concatenate(smooth), [3, 6], axis=1)
    trend = np.linalg.qr(np.vander(instants - instants.mean(), _TREND))[0]  # a bias that drifts

    def detrended(columns: Array) -> Array:
        return np.asarray(columns - trend @ (trend.T @ columns))

    force = detrended(at_times(instants, times, force))

    def regressors(lag: float) -> Array:
        felt = (
            at_times(instants - lag, times, acceleration),
            at_times(instants - lag + gyroscope_s, times, turned),
        )
        return detrended(np.concatenate(felt, axis=1))

    def residual(lag: float) -> float:
        rows = regressors(lag)
        return float(((force - rows @ np.linalg.lstsq(rows, force, rcond=None)[0]) ** 2).sum())

    coarse = np.arange(_EARLIEST_S, _LATEST_S, max(period, 0.005))
    best = lowest(residual, float(coarse[np.argmin([residual(lag) for lag in coarse])]), max(period, 0.005))
    rows = regressors(best)
    tool = np.linalg.lstsq(rows, force, rcond=None)[0]
    total = float((force**2).sum())
    explained = 1.0 - residual(best) / total if total else 0.0
    if explained < _EXPLAINED:
        raise CompensationError(
            f"motion explains only {100 * explained:.0f} % of the force: shake the sensor with a tool on it "
            "that nothing touches"
        )
    # Of each part the lag that fits best beside it, from the slope of the specific force.
    slope = ((regressors(best - period) - regressors(best + period)) / (2 * period)) @ tool
    residuals = force - rows @ tool
    lags = []
    for part, rest in zip(np.array_split(slope, _PARTS), np.array_split(residuals, _PARTS), strict=True):
        steepness = float(((part - part.mean(axis=0)) ** 2).sum())
        lags.append(-float(((part - part.mean(axis=0)) * rest).sum()) / max(steepness, 1e-30))
    step = max(period, 0.002)
    curve = max(residual(best - step) - 2 * residual(best) + residual(best + step), 1e-300) / step**2
    degrees = max(3 * len(instants) / 4 - 3 * rows.shape[1], 1.0)
    interval = _T_95 * max(
        float(np.std(lags, ddof=1)) / math.sqrt(_PARTS), math.sqrt(2 * residual(best) / (curve * degrees))
    )
    if not interval < _WIDEST_S:
        raise CompensationError(
            f"the motion is too slow to tell ({best * 1e3:.0f} ± {min(interval, 10.0) * 1e3:.0f} ms): shake "
            "the sensor faster, two to five times a second in all directions"
        )
    return Lag(best, interval, explained)


def _stretches(times: Array, samples: Array, least_s: float) -> tuple[float, Sequence[tuple[Array, Array]]]:
    """The usual period, and what `resampled` makes of it; CompensationError if that is too short."""
    period, parts = resampled(times, samples, least_s)
    if (seconds := sum(float(grid[-1] - grid[0]) for grid, _ in parts)) < _LEAST_S:
        raise CompensationError(f"{seconds:.1f} s without a gap are too few: shake the sensor for 10 s")
    return period, parts


def check_held_out(
    stamps: Array, samples: Array, settings: Mapping[str, SettingValue], lag: Lag
) -> tuple[float, float]:
    """Force left, rms N, aligned by this lag and not aligned, in each part by a tool of the other parts.

    Of `samples` (n, 9): N, m/s² and rad/s, by the samples that compensation has: what it looks ahead costs
    what it costs. CompensationError if the alignment makes it worse.
    """
    period, parts = _stretches(stamps, samples, _LATEST_S)
    both = align(settings, 1.0 / period, lag.seconds), align({}, 1.0 / period)
    aligned, not_aligned = (_held_out([columns for _, columns in parts], each) for each in both)
    if not min(aligned, not_aligned) < _LEFT * float(np.linalg.norm(samples[:, :3].std(axis=0))):
        raise CompensationError(
            "the motion in parts of the recording does not tell the force in the others: shake the sensor "
            "all the time, in all directions, and let nothing touch the tool"
        )
    if aligned < _AS_GOOD * not_aligned:
        return aligned, not_aligned
    raise CompensationError(
        f"a lag of {lag.seconds * 1e3:.2f} ms fits best, but compensation by it leaves {aligned:.2g} N in "
        f"parts of the recording that did not choose it, and {not_aligned:.2g} N without: do not use it"
    )


def _held_out(stretches: Iterable[Array], alignment: Alignment) -> float:
    found, begin = list[tuple[Array, Array]](), alignment.taps.shape[1]
    for force, *imu in (np.split(samples, [3, 6], axis=1) for samples in stretches):
        columns = zip((*imu, imu[1]), alignment.taps[:, ::-1], strict=True)
        felt, turned, spun = (smoothed(each, taps, "full")[: len(force)] for each, taps in columns)
        part = np.concatenate([felt, spun, _products(turned), np.ones((len(felt), 1))], axis=1)
        found.append((part[begin:], force[begin:]))
    rows, force = map(np.concatenate, zip(*found, strict=True))
    squares = 0.0
    for part in np.array_split(np.arange(len(rows)), _PARTS):
        tool = np.linalg.lstsq(np.delete(rows, part, 0), np.delete(force, part, 0), rcond=None)[0]
        squares += float(((force[part] - rows[part] @ tool) ** 2).sum())
    return math.sqrt(squares / len(rows))


def _products(rate: Array) -> Array:
    return np.asarray((rate[:, :, None] * rate[:, None]).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])


def lowest(function: Callable[[float], float], start: float, step: float) -> float:
    """The minimum of a function near `start`, by parabolas."""
    for _ in range(6):
        before, at, after = function(start - step), function(start), function(start + step)
        curve = before - 2 * at + after
        start += step * min(max((before - after) / (2 * curve), -1.0), 1.0) if curve > 0 else 0.0
        step /= 2
    return start
