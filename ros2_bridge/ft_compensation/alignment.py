"""Brings the specific force to the instant and the bandwidth of force and torque before they are subtracted.

The sensor's filters delay force and torque by 0.9 ms (SINC 32) to 120 ms (SINC 512 with FIR), what its
accelerometer measures by 1.9 ms (`bota_ethercat.sensor.response`). The specific force is delayed by the
difference: with FIR off between two samples, with FIR on by the same window, so that both pass the same
frequencies. An IMU that is later than the force is used as it comes: nobody wants the wrench later.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from bota_ethercat.pdo import Vector3
from bota_ethercat.sensor.response import FIR_TAPS, force_lag_s, kaiser
from bota_ethercat.settings import SettingValue

# Differences below this part of a sample period are left.
_NEGLIGIBLE: Final = 0.1
# Samples that were lost in a row for which the one before stands; after more, the history begins anew.
_MOST_LOST: Final = 4
NOT_DELAYED: Final = (1.0,)


def alignment_taps(settings: Mapping[str, SettingValue], rate_hz: float) -> tuple[float, ...]:
    """The weights of the newest specific force and those before it; NOT_DELAYED if a delay is unknown."""
    lag = (force_lag_s(settings, rate_hz) or 0.0) * rate_hz  # in sample periods
    if lag < _NEGLIGIBLE:
        return NOT_DELAYED
    if not settings.get("fir"):
        whole, part = divmod(lag, 1.0)
        return (0.0,) * int(whole) + (1.0 - part, part)
    half = (FIR_TAPS - 1) / 2
    window = [kaiser((k - lag) / half) for k in range(math.floor(lag + half) + 1)]
    return tuple(value / sum(window) for value in window)


class Alignment:
    """Of the samples of one sensor, each to be passed to `follow` once."""

    def __init__(self, taps: tuple[float, ...] = NOT_DELAYED, period_s: float = 0.0) -> None:
        """`taps` as `alignment_taps` gives them; samples are `period_s` apart."""
        self._count, self._period_s = len(taps), period_s
        self._taps = np.array(taps[::-1])  # the oldest first, as in `_history`
        self._history = np.zeros((2 * self._count, 3))  # each row twice, so that the newest are in one piece
        self._at = self._filled = 0
        self._time_s = -math.inf

    def follow(self, value: Vector3, time_s: float) -> Vector3:
        """`value` as it was when force and torque of this sample were; of finite numbers."""
        count = self._count
        if count == 1:
            return value
        lost = round((time_s - self._time_s) / self._period_s) - 1 if self._filled else 0
        self._time_s = time_s
        if not 0 <= lost <= _MOST_LOST:
            self._filled = lost = 0
        for _ in range(lost + 1):
            self._at = at = (self._at + 1) % count
            self._history[at] = self._history[at + count] = value
        self._filled += lost + 1
        end = at + count + 1
        if self._filled >= count:
            x, y, z = (self._taps @ self._history[end - count : end]).tolist()
            return x, y, z
        taps = self._taps[-self._filled :]
        if not (total := float(taps.sum())) > 0.0:
            return value
        x, y, z = (taps @ self._history[end - self._filled : end] / total).tolist()
        return x, y, z
