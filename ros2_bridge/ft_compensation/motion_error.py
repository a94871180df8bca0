# SPDX-License-Identifier: Apache-2.0
"""What the compensation of a moving tool cannot know, in N: from the IMU's samples of about a second.

- Filters: by the spectrum of acceleration and angular rate, what force and torque have of them (magnitude and
  delay of their filter, over that of the IMU's) less what the alignment has made of them, and the noise that
  it lets through. It grows with vibrations that one filter passes and the other does not. It holds for what
  is slower than half of the sampling rate (50 Hz at SINC 512): what is faster looks like something slower, of
  which the force has another share. The IMU is assumed to be sampled together with the force: the samples of
  one that has its own 1 kHz are up to 1 ms older, which shows as fast turns that are none, and is an error
  in fast vibrations that is not told.
- Range: while an axis reads its limit, the acceleration is taken for a parabola that leaves the limit as
  steeply as it came there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.sensor.response import acceleration_response, angular_rate_response, force_torque_response
from ft_compensation.alignment import Alignment, Array
from ft_compensation.quantities import length

FEWEST: Final = 64  # samples
_NEAR_LIMIT: Final = 0.95  # of the range: offset and scale shift where an axis ends
_ABOVE_NOISE: Final = 16.0  # times the noise's power: so much has one of ten million bins of noise
_GAINS: Final = 65  # frequencies at which the filters' magnitudes are computed
_FASTEST_TURN_HZ: Final = 150.0  # no tool turns faster: what the gyroscope has of that is not in the force
_FLAT: Final = 0.002  # of the range: noise of what reads the limit


class MotionError(NamedTuple):
    """Force that compensation leaves, N."""

    filters: float  # root mean square
    out_of_range: float  # largest; 0 as long as no axis reads its limit


def motion_error(rows: Array, alignment: Alignment, lever: Vector3, mass: float) -> MotionError | None:
    """From `rows` (n, 6), m/s² and rad/s, the newest last; None: too few, or an unknown delay."""
    if len(rows) < FEWEST or alignment.lag_s is None:
        return None
    excess = max((size for axis in range(6) for size in _exceeded(rows, axis, alignment, lever)), default=0.0)
    return MotionError(mass * _mismatched(rows, alignment, lever), mass * excess)


def _mismatched(rows: Array, alignment: Alignment, lever: Vector3) -> float:
    """Root mean square, m/s²."""
    settings, lag_s = alignment.settings, alignment.lag_s or 0.0
    hertz = np.fft.rfftfreq(len(rows), alignment.period_s)
    turns = 2j * np.pi * hertz
    force, *imu = (
        response(settings)
        for response in (force_torque_response, acceleration_response, angular_rate_response)
    )
    # What force and torque have of what the accelerometer and the gyroscope read.
    later_s = (imu[1].delay_s or 0.0) - (imu[0].delay_s or 0.0)
    coarse = np.linspace(0.0, hertz[-1], _GAINS)
    passed = [
        np.interp(hertz, coarse, [force.gain(hz) / each.gain(hz) for hz in coarse.tolist()])
        * np.exp(-turns * (lag_s - by_s))
        for each, by_s in zip(imu, (0.0, later_s), strict=True)
    ]
    passed[1][hertz > _FASTEST_TURN_HZ] = 0.0
    ages_s = alignment.period_s * np.arange(alignment.taps.shape[1])[::-1]
    used = alignment.taps @ np.exp(-ages_s[:, np.newaxis] * turns)
    window = np.hanning(len(rows))[:, np.newaxis]
    spectrum = np.fft.rfft(window * (rows - rows.mean(axis=0)), axis=0)
    power = np.abs(spectrum) ** 2
    noise = np.median(power[len(power) // 2 :], axis=0) / math.log(2.0)
    spectrum[power < _ABOVE_NOISE * noise] = 0.0
    of_acceleration = (passed[0] - used[0])[:, np.newaxis] * spectrum[:, :3]
    turned = (turns * passed[1] - used[2])[:, np.newaxis] * spectrum[:, 3:]
    left = np.abs(of_acceleration + np.cross(turned, lever)) ** 2
    square = np.array(lever) ** 2
    of_noise = noise[:3].sum() * np.abs(used[0]) ** 2
    of_noise += noise[3:] @ (square.sum() - square) * np.abs(used[2]) ** 2
    return math.sqrt(2.0 * float(left.sum() + of_noise.sum()) / len(rows) / float((window**2).sum()))


def _exceeded(rows: Array, axis: int, alignment: Alignment, lever: Vector3) -> Iterator[float]:
    """m/s²: by how much what the axis could not read may be wrong, of each time it read its limit."""
    if axis < 3:
        limit = STANDARD_GRAVITY * alignment.settings.get("acceleration_range_g", math.inf)
    else:
        limit = math.radians(alignment.settings.get("angular_rate_range_dps", math.inf))
    values = np.abs(rows[:, axis])
    if not values.max() > _NEAR_LIMIT * limit:
        return
    # The gyroscope is not corrected: an axis that reads its limit reads one number.
    flat = values >= values.max() - (_FLAT * limit if axis < 3 else 0.0)
    edges = np.flatnonzero(np.diff(flat, prepend=False, append=False))
    for begin, end in edges.reshape(-1, 2).tolist():
        if begin > 1 and end - begin > 1:
            slope = (values[begin - 1] - values[begin - 2]) / alignment.period_s
            seconds = (end - begin) * alignment.period_s
            yield float(0.25 * slope * seconds if axis < 3 else slope * length(lever))
