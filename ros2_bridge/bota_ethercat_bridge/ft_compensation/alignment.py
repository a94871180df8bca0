# SPDX-License-Identifier: Apache-2.0
"""What brings the IMU's samples to the instant and the bandwidth of force and torque.

The sensor's filters delay force and torque by 0.9 ms (SINC 32) to 120 ms (SINC 512 with FIR), what its
accelerometer measures by 1.9 ms and its gyroscope by 2.9 ms (`bota_ethercat.sensor.response`). A polynomial
through the latest samples is evaluated at the instant that force and torque are of (docs/compensation.md).
The slope of a parabola is taken 1.5 ms before the newest sample at the latest: nearer, noise grows steeply.
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
    force_lag_s,
    kaiser,
)
from bota_ethercat.settings import SettingValue

Array = NDArray[np.float64]

_UNKNOWN_HZ: Final = 1600.0  # taken for a rate that is unknown: samples that are fewer are interpolated
_NEGLIGIBLE: Final = 0.1  # of a sample period
_PARABOLA_S, _LINE_S = 0.014, 0.0025  # lengths of the fits
_LATEST_SLOPE_S: Final = 0.0015
_FURTHEST_S: Final = 0.002
# Over lost samples the IMU's are interpolated: with FIR on, as its window is longer, for so long; else an
# angular acceleration would be too late by half of the gap.
_LONGEST_GAP_S: Final = 0.1
_GAP_S, _GAP_PERIODS = 0.008, 2.5


class Alignment(NamedTuple):
    """Weights of the IMU's latest samples, the oldest first."""

    period_s: float
    taps: Array  # (3, n): to acceleration, angular rate and angular acceleration
    lag_s: float | None  # by which force and torque are later than the accelerometer; None: unknown
    gap_s: float  # samples further apart do not belong together
    lead: int  # so many samples after a gap tell nothing of the instant that force and torque are of
    settings: Mapping[str, SettingValue]


def align(
    settings: Mapping[str, SettingValue], rate_hz: float = 0.0, lag_s: float | None = None
) -> Alignment:
    """For these settings and sampling rate; `lag_s` as `ethercat-identify delay` has measured it.

    Where the lag is unknown, acceleration is used as it comes.
    """
    known_s = force_lag_s(settings, rate_hz or None) if lag_s is None else lag_s
    is_known, rate_hz = rate_hz > 0.0, rate_hz or _UNKNOWN_HZ
    delays_s = [response(settings).delay_s for response in (acceleration_response, angular_rate_response)]
    accelerometer_s, gyroscope_s = (delay_s or 0.0 for delay_s in delays_s)
    at_s = min(-(known_s or 0.0), _FURTHEST_S)  # after the newest sample
    turned_s = min(at_s + gyroscope_s - accelerometer_s, _FURTHEST_S)
    gap_s = _LONGEST_GAP_S
    if settings.get("fir") and known_s is not None:
        window = _window(-at_s * rate_hz)
        slope = np.convolve(_window(-turned_s * rate_hz - 1.0), (0.5 * rate_hz, 0.0, -0.5 * rate_hz))
        rows = [window, _window(-turned_s * rate_hz), slope]
    else:
        if is_known:
            gap_s = max(_GAP_S, _GAP_PERIODS / rate_hz)
        count = max(3, round(_PARABOLA_S * rate_hz) + 1)
        slope_at = min(turned_s, -_LATEST_SLOPE_S) * rate_hz
        rows = [
            _value(at_s * rate_hz, max(2, round(_LINE_S * rate_hz) + 1)),
            _fit(2, count, turned_s * rate_hz)[0],
            _fit(2, count, slope_at)[1] * rate_hz,
        ]
    taps = np.zeros((3, max(map(len, rows))))
    for row, weights in zip(taps, rows, strict=True):
        row[len(row) - len(weights) :] = weights[::-1]
    lead = 1 + math.floor(max(-at_s, 0.0) * rate_hz)
    return Alignment(1.0 / rate_hz, taps, known_s, gap_s, lead, settings)


def _value(at: float, count: int) -> Array:
    """Of the newest sample and those before it, at `at` sample periods after the newest."""
    if abs(at) < _NEGLIGIBLE:
        return np.ones(1)
    if at > 0.0:
        return np.asarray(_fit(1, count, at)[0])
    whole, part = divmod(-at, 1.0)
    return np.array([0.0] * int(whole) + [1.0 - part, part])


def _fit(order: int, count: int, at: float) -> Array:
    """Value, slope, ... at this instant of the polynomial through so many samples, by least squares."""
    fitted: Array = np.linalg.pinv(np.vander(-np.arange(count) - at, order + 1, increasing=True))
    return fitted


def _window(center: float) -> Array:
    """The FIR filter's, that many sample periods before the newest sample."""
    half = (FIR_TAPS - 1) / 2
    window = np.array([kaiser((k - center) / half) for k in range(max(1, math.floor(center + half) + 1))])
    return np.asarray(window / window.sum())
