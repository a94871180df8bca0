"""Finds the periods of a recording in which the sensor was stationary.

The recording is divided into short blocks. Quiet blocks in a row with the same pose make a period. Its first
and last block, in which a hand may have touched it or the robot may have swung, are excluded; the remainder
must pass the same test as a pose that is taken live.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from bota_clients.recording.columns import Bools, Columns, Floats
from bota_ethercat.sensor.rest import StationaryLimits
from bota_ethercat.stream.usable import ACCELERATION, ANGULAR_RATE, FORCE_TORQUE
from bota_ft_compensation.identification.resampling import GAP_S, stretches
from bota_ft_compensation.stationary import (
    CHANCE,
    NotStationaryError,
    StationaryMeans,
    stationary_means,
)

LEAST_S: Final = 1.0  # shorter periods are no poses
_BLOCK_S: Final = 0.1
_BLOCK_SAMPLES: Final = 8  # at least, however slow the sensor is
_SAME_POSE: Final = math.cos(math.radians(1.5))
_LIMITS: Final = StationaryLimits()


class StationaryPeriod(NamedTuple):
    begin_s: float  # from the beginning of the recording
    seconds: float
    means: StationaryMeans


def find_stationary_periods(
    columns: Columns, least_seconds: float = LEAST_S
) -> tuple[list[StationaryPeriod], list[str]]:
    """The stationary periods of at least `least_seconds`, in order; sentences about those that nearly are."""
    fresh = columns.where(columns.fresh)
    periods: list[StationaryPeriod] = []
    rejected: list[str] = []
    if len(fresh) < _BLOCK_SAMPLES:
        return periods, rejected
    rows, good = usable_rows(fresh)
    times = (fresh.monotonic_ns - fresh.monotonic_ns[0]) * 1e-9
    rows = np.where(good[:, np.newaxis], rows, 0.0)
    for part in stretches(times, GAP_S):
        if part.stop - part.start < 3 * _BLOCK_SAMPLES:
            continue
        for begin, end in _stretches(times[part], rows[part], good[part]):
            first, last = part.start + begin, part.start + end
            seconds = float(times[last - 1] - times[first])
            if seconds < least_seconds:
                continue
            try:
                means = stationary_means(rows[first:last], _LIMITS)
            except NotStationaryError as error:
                rejected.append(f"{times[first]:.1f} s to {times[last - 1]:.1f} s: {error}")
            else:
                middle_s = float(times[first]) + 0.5 * seconds
                periods.append(
                    StationaryPeriod(float(times[first]), seconds, means._replace(time_s=middle_s))
                )
    return periods, rejected


def usable_rows(columns: Columns) -> tuple[Floats, Bools]:
    """(n, 12) force, torque, acceleration, angular rate; (n,) whether they may be used."""
    rows = np.hstack([columns.force, columns.torque, columns.acceleration, columns.angular_rate])
    flagged = sum(channel.flagged(columns) for channel in (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE))
    good: Bools = np.isfinite(rows).all(axis=1) & (flagged == 0)
    return rows, good


def _stretches(times: Floats, rows: Floats, good: Bools) -> Iterator[tuple[int, int]]:
    """First row and the row after the last one of every period, without its first and last block."""
    period = float(times[-1] - times[0]) / (len(times) - 1)
    size = max(_BLOCK_SAMPLES, round(_BLOCK_S / period))
    count = len(rows) // size
    blocks = rows[: count * size].reshape(count, size, rows.shape[1])
    mean, deviation = blocks.mean(axis=1), blocks.std(axis=1, ddof=1)
    quiet = good[: count * size].reshape(count, size).all(axis=1)
    quiet &= (deviation <= _LIMITS.deviations).all(axis=1)
    quiet &= np.linalg.norm(mean[:, 9:12], axis=1) <= _LIMITS.angular_rate

    def is_same_period(start: int, number: int) -> bool:
        """Whether block `number` belongs to the period that began with block `start`."""
        if not (quiet[start] and quiet[number]):
            return False
        a, b = mean[start], mean[number]
        sizes = float(np.linalg.norm(a[6:9]) * np.linalg.norm(b[6:9]))
        if float(a[6:9] @ b[6:9]) < _SAME_POSE * sizes:
            return False
        by_chance = CHANCE * (deviation[start] + deviation[number]) / math.sqrt(size)
        moved = np.abs(b - a) - by_chance
        return bool((moved[:6] <= _LIMITS.drifts[:6]).all())  # of the acceleration the pose was compared

    start = 0
    for number in range(1, count + 1):
        if number < count and is_same_period(start, number):
            continue
        if quiet[start] and number - start >= 3:
            yield (start + 1) * size, (number - 1) * size
        start = number
