"""What is measured of a sensor beside its stream: its noise.

Noise is compared with a healthy sensor although the sensor may move and touch things: docs/report.md says
how. The range of the cubics of force and torque tells contacts and quick motion; if the accelerometer shows
that the sensor was shaken even in the calm windows, vibration cannot be told from noise. A median misses
intermittent noise, so every window is also judged by its second differences, which motion hardly affects.
"""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple

import numpy as np

from bota_clients.recording.columns import Floats, Ints
from bota_clients.report.series import CHANNELS, Bools, Series, channel_limit

_WINDOW_S: Final = 0.5
_FEWEST_SAMPLES: Final = 32  # in a window
FEWEST_WINDOWS: Final = 8  # to judge by
_ORDER: Final = 3
# A window above this multiple of the limit is noisy; one of few samples needs more, to allow for chance.
_NOISY: Final = 1.5
_CONTACT_S: Final = 0.1  # a contact builds up in no less, which second differences of slow samples show, too
_TO_DEVIATION: Final = 1.4826 / math.sqrt(6)  # median size of second differences of white noise to its std
_FILLED: Final = 0.8  # share of its samples that a window must have


class Noise(NamedTuple):
    """Noise of the 12 channels, as standard deviations; NaN if unknown."""

    deviation: Floats  # (12,)
    limit: Floats  # (12,) of a healthy sensor
    windows: int
    calm: int  # how many of the windows were used
    window_s: float
    noisy: Ints  # (12,) windows that are clearly above the limit, of all
    worst: Floats  # (12,) standard deviation in the worst of these

    @property
    def shaken(self) -> bool:
        """Whether the sensor was shaken, even in the calm windows."""
        return bool(_shaken(self.deviation, self.limit))


def measure_noise(series: Series) -> Noise:
    length = max(_WINDOW_S, _FEWEST_SAMPLES * series.period)
    limit = _limits(series)
    usable = series.finite & ~series.saturated
    number = np.floor(series.time / length).astype(np.int64)
    # A clock that jumps back must not join samples that are far apart.
    edges = [0, *(np.flatnonzero(np.diff(number) != 0) + 1), series.count]
    fewest = max(_FEWEST_SAMPLES // 2, int(_FILLED * length / series.period))
    kept = [slice(*ends) for ends in itertools.pairwise(edges) if ends[1] - ends[0] >= fewest]
    if len(kept) < FEWEST_WINDOWS:
        unknown = np.full(len(CHANNELS), np.nan)
        return Noise(unknown, limit, len(kept), 0, length, np.zeros(len(CHANNELS), np.int64), unknown)
    windows = [_window(series.time[part], series.values[part], usable[part]) for part in kept]
    deviations, ranges, roughs = np.array(windows).transpose(1, 0, 2)
    # A window in which a channel is unusable counts as the least calm.
    reaches = np.where(np.isfinite(ranges), ranges, np.inf)[:, :6]
    usual = np.median(reaches, axis=0)
    known = (usual > 0) & np.isfinite(usual)
    unrest = (reaches[:, known] / usual[known]).max(axis=1, initial=0.0)
    calm = deviations[np.argsort(unrest, kind="stable")[: max(FEWEST_WINDOWS, len(unrest) // 2)]]
    measured = np.sum(np.isfinite(calm), axis=0) >= FEWEST_WINDOWS // 2
    deviation = np.full(len(CHANNELS), np.nan)
    deviation[measured] = np.nanmedian(calm[:, measured], axis=0)
    rough = np.where(_shaken(deviations, limit)[:, None], np.nan, roughs)
    sizes = np.array([part.stop - part.start for part in kept])
    touched = ranges * (series.period / _CONTACT_S) ** 2
    noisy = rough > limit * np.maximum(_NOISY, 1 + 5 / np.sqrt(sizes))[:, None] + touched
    worst = np.where(noisy, rough, 0.0).max(axis=0)
    return Noise(deviation, limit, len(kept), len(calm), length, noisy.sum(axis=0), worst)


def _shaken(deviation: Floats, limit: Floats) -> Bools:
    """Whether at least two axes of the accelerometer are above their limit: that is motion."""
    shaken: Bools = np.sum(deviation[..., 6:9] > limit[6:9], axis=-1) >= 2
    return shaken


def _limits(series: Series) -> Floats:
    """(12,) NaN where there is none: raw counts, an unknown SINC length, an IMU that is off."""
    length = series.subject.sinc_length if series.subject.settings.get("calibration_matrix") else None
    return np.array([
        math.nan if (series.imu_off if channel.group.is_imu else length is None)
        else channel_limit(channel, length or 1)
        for channel in CHANNELS
    ])  # fmt: skip


def _window(time: Floats, values: Floats, usable: Bools) -> Floats:
    """(3, 12): standard deviation about the cubic, its range, and the deviation by second differences."""
    middle, half = (time[0] + time[-1]) / 2, max((time[-1] - time[0]) / 2, 1e-12)
    basis = np.polynomial.legendre.legvander((time - middle) / half, _ORDER)
    good = usable.all(axis=0)
    values = np.where(good, values, 0.0)
    trend = basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    deviation = np.sqrt(np.sum((values - trend) ** 2, axis=0) / (len(time) - _ORDER - 1))
    deviation[(values == values[0]).all(axis=0)] = 0.0  # the fit leaves rounding errors
    rough = np.median(np.abs(np.diff(values, 2, axis=0)), axis=0) * _TO_DEVIATION
    return np.where(good, [deviation, np.ptp(trend, axis=0), rough], np.nan)
