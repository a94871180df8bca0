# SPDX-License-Identifier: Apache-2.0
"""What brings the IMU's samples to the instant and the bandwidth of force and torque.

The sensor's filters delay force and torque by 0.9 ms (SINC 32) to 120 ms (SINC 512 with FIR), what its
accelerometer measures by 1.9 ms and its gyroscope by 2.9 ms (`bota_ethercat.sensor.response`). Weighted sums
of the IMU's latest samples are what the filters of force and torque make of the motion: exactly, if it is a
line; else with the least error that is to be expected, of what arms do and of the IMU's noise, which grows
where they look ahead (Wiener's filter; docs/compensation.md). `Alignment` of compensation.hpp is its twin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.sensor.response import (
    FIR_TAPS,
    acceleration_response,
    angular_rate_response,
    fir_gain,
    force_lag_s,
    imu_noise,
    sinc_gain,
)
from bota_ethercat.settings import SettingValue

Array = NDArray[np.float64]

_UNKNOWN_HZ: Final = 1600.0  # taken for a rate that is unknown: samples that are fewer are interpolated
_HISTORY_S: Final = 0.014, 0.025  # of acceleration and angular rate: what precedes it tells hardly more
# Motion that is expected beyond a line: rms, m/s² and rad/s, Hz up to which its density is about constant,
# and how steeply it falls. Chosen by what is left of moves, polishing and vibration; the optimum is flat.
_ACCELERATION, _RATE = (10.0, 9.0, 3), (6.0, 8.0, 8)
_HERTZ: Final = 0.5 * 2.0 ** (np.arange(21) / 2)
# Extrapolation goes no further, though slow filters of the IMU ask for up to 65 ms: its noise grows with it.
_FURTHEST_S: Final = 0.002
# Over lost samples the IMU's are interpolated: for so long, or so many periods; with FIR on, as its window is
# longer, for longer.
_GAP_S, _FIR_GAP_S, _GAP_PERIODS = 0.008, 0.015, 2.5
_UNKNOWN_GAP_S: Final = 0.1  # where the rate is unknown
# The motion before the end of a gap is extrapolated from so much after it: over less, noise makes the slope.
_LINE_S: Final = 0.004


class Alignment(NamedTuple):
    """Weights of the IMU's latest samples, the oldest first."""

    period_s: float
    taps: Array  # (3, n): to acceleration, angular rate and angular acceleration
    lag_s: float | None  # by which force and torque are later than the accelerometer; None: unknown
    gap_s: float  # samples further apart do not belong together
    lead: int  # so many samples are needed after a gap to tell the instant of force and torque
    settings: Mapping[str, SettingValue]

    def noise(self, lever_m: float = 0.0) -> tuple[float, float]:
        """Deviations, m/s² on each axis so far from the IMU, and rad/s², by its filters' noise."""
        acceleration, rate = imu_noise(self.settings)
        spin = rate * float(np.linalg.norm(self.taps[2]))
        return math.hypot(acceleration * float(np.linalg.norm(self.taps[0])), spin * lever_m), spin


def align(
    settings: Mapping[str, SettingValue], rate_hz: float = 0.0, lag_s: float | None = None
) -> Alignment:
    """For these settings and sampling rate; `lag_s` as `ethercat-identify delay` has measured it.

    Where the lag is unknown, acceleration is used as it comes.
    """
    known_s = force_lag_s(settings, rate_hz or None) if lag_s is None else lag_s
    is_known, rate_hz = rate_hz > 0.0, rate_hz or _UNKNOWN_HZ
    at_s, fir = known_s or 0.0, bool(settings.get("fir")) and known_s is not None
    lags_s = (max(lag_s, -_FURTHEST_S) for lag_s in (at_s, at_s - gyroscope_later_s(settings)))
    gains = [
        1.0 if known_s is None else sinc_gain(share) * (fir_gain(share) if fir else 1.0)
        for share in (_HERTZ / rate_hz).tolist()
    ]
    ahead = math.ceil(max(at_s, 0.0) * rate_hz)
    counts = [ahead + (FIR_TAPS // 2 + 2 if fir else max(3, round(each * rate_hz))) for each in _HISTORY_S]
    given, count = np.array(gains), counts[1]
    (value, _), turned = (
        _weights(motion, noise, np.arange(length) / rate_hz, lag, given)
        for motion, noise, lag, length in zip(
            (_ACCELERATION, _RATE), imu_noise({}), lags_s, counts, strict=True
        )
    )
    value = np.ones(1) if known_s is None else value
    taps = np.array([np.pad(value, (0, count - len(value))), *turned])[:, ::-1]
    gap_s = max(_FIR_GAP_S if fir else _GAP_S, _GAP_PERIODS / rate_hz) if is_known else _UNKNOWN_GAP_S
    lead = 1 + math.floor(max(at_s, 0.0) * rate_hz) + 2 * fir
    lead = min(lead + max(1, math.ceil(_LINE_S * rate_hz)), count)
    return Alignment(1.0 / rate_hz, np.ascontiguousarray(taps), known_s, gap_s, lead, settings)


def gyroscope_later_s(settings: Mapping[str, SettingValue]) -> float:
    """By how much the gyroscope is later than the accelerometer; a delay that is unknown counts as 0."""
    accelerometer, gyroscope = (each(settings) for each in (acceleration_response, angular_rate_response))
    return (gyroscope.delay_s or 0.0) - (accelerometer.delay_s or 0.0)


def _weights(
    motion: tuple[float, float, int], noise: float, ages: Array, lag_s: float, gains: Array
) -> Array:
    """(2, n): of samples of these `ages`, to value and slope `lag_s` before now behind filters of `gains`."""
    (rms, from_hz, steepness), pace = motion, 2.0 * math.pi * _HERTZ
    band = 0.5 * math.log(2.0) * _HERTZ / from_hz
    expected = rms**2 * band / (1.0 + (_HERTZ / from_hz) ** 2) ** steepness
    alike = (expected @ np.cos(np.outer(pace, ages)))[np.abs(np.subtract.outer(*[np.arange(len(ages))] * 2))]
    line, late = np.stack([np.ones(len(ages)), ages]), np.outer(pace, ages - lag_s)
    normal = np.block([[alike + noise**2 * np.eye(len(ages)), line.T], [line, np.zeros((2, 2))]])
    seen = expected * gains
    wanted = [[*(seen @ np.cos(late)), 1.0, lag_s], [*(-(seen * pace) @ np.sin(late)), 0.0, -1.0]]
    return np.asarray(np.linalg.solve(normal, np.array(wanted).T)[: len(ages)].T)
