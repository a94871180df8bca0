"""Finds the periods of a recording in which the sensor was stationary.

The recording is divided into short blocks. Quiet blocks in a row with the same pose make a period. Its first
and last block, in which a hand may have touched it or the robot may have swung, are excluded; the remainder
must pass the same test as a pose that is taken live.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
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
_ENOUGH: Final = 512  # samples that tell how far apart they are
_MOST_SAMPLES: Final = 200_000  # longer periods are divided, so that memory is bounded
_SAME_POSE: Final = math.cos(math.radians(1.5))
_LIMITS: Final = StationaryLimits()


class StationaryPeriod(NamedTuple):
    begin_s: float  # from the beginning of the recording
    seconds: float
    means: StationaryMeans


def find_stationary_periods(
    parts: Iterable[Columns], least_seconds: float = LEAST_S
) -> tuple[list[StationaryPeriod], list[str]]:
    """The stationary periods of at least `least_seconds`, in order; sentences about those that nearly are."""
    found = _Finder(least_seconds)
    for part in parts:
        found.add(part)
    found.end_stretch()
    return found.periods, found.rejected


def usable_rows(columns: Columns) -> tuple[Floats, Bools]:
    """(n, 12) force, torque, acceleration, angular rate; (n,) whether they may be used."""
    rows = np.hstack([columns.force, columns.torque, columns.acceleration, columns.angular_rate])
    flagged = sum(channel.flagged(columns) for channel in (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE))
    good: Bools = np.isfinite(rows).all(axis=1) & (flagged == 0)
    return rows, good


_TIME, _GOOD, _ROW = 0, 1, slice(2, None)  # columns of what `_Finder` holds


class _Finder:
    """Finds the periods while samples come; holds those of the period that goes on."""

    def __init__(self, least_seconds: float) -> None:
        self.periods, self.rejected = list[StationaryPeriod](), list[str]()
        self._least_s, self._begin_ns = least_seconds, -1
        self._rest, self._held = np.zeros((0, 14)), list[Floats]()  # of no whole block yet; of the period
        self._size = 0  # samples in a block; 0: to be told by the first ones of the stretch
        self._last_s = -math.inf

    def add(self, frames: Columns) -> None:
        fresh = frames.where(frames.fresh)
        if not len(fresh):
            return
        self._begin_ns = int(fresh.monotonic_ns[0]) if self._begin_ns < 0 else self._begin_ns
        rows, good = usable_rows(fresh)
        times = (fresh.monotonic_ns - self._begin_ns) * 1e-9
        table = np.column_stack([times, good, np.where(good[:, np.newaxis], rows, 0.0)])
        for part in stretches(np.append(self._last_s, times), GAP_S):
            if part.start:
                self.end_stretch()
            self._rest = np.concatenate([self._rest, table[max(part.start - 1, 0) : part.stop - 1]])
            if self._size or len(self._rest) >= _ENOUGH:
                self._take()
        self._last_s = float(times[-1])

    def end_stretch(self) -> None:
        """A gap, or the end."""
        if len(self._rest) >= 3 * _BLOCK_SAMPLES or self._size:
            self._take()
        self._end_period()
        self._rest, self._size = self._rest[:0], 0

    def _take(self) -> None:
        rest = self._rest
        if not self._size:
            period = float(rest[-1, _TIME] - rest[0, _TIME]) / (len(rest) - 1)
            self._size = max(_BLOCK_SAMPLES, round(_BLOCK_S / period))
        count = len(rest) // self._size
        blocks, self._rest = np.split(rest, [count * self._size])
        blocks = blocks.reshape(count, self._size, 14)
        mean, deviation = blocks[:, :, _ROW].mean(axis=1), blocks[:, :, _ROW].std(axis=1, ddof=1)
        quiet = blocks[:, :, _GOOD].all(axis=1) & (deviation <= _LIMITS.deviations).all(axis=1)
        quiet &= np.linalg.norm(mean[:, 9:12], axis=1) <= _LIMITS.angular_rate
        for number in range(count):
            if not self._continues(quiet[number], mean[number], deviation[number]):
                self._end_period()
                self._start = quiet[number], mean[number], deviation[number]
            self._held.append(blocks[number])

    def _continues(self, is_quiet: bool, mean: Floats, deviation: Floats) -> bool:
        """Whether a block belongs to the period that goes on."""
        if not self._held or len(self._held) * self._size >= _MOST_SAMPLES:
            return False
        was_quiet, a, its_deviation = self._start
        if not (was_quiet and is_quiet):
            return False
        sizes = float(np.linalg.norm(a[6:9]) * np.linalg.norm(mean[6:9]))
        if float(a[6:9] @ mean[6:9]) < _SAME_POSE * sizes:
            return False
        by_chance = CHANCE * (its_deviation + deviation) / math.sqrt(self._size)
        moved = np.abs(mean - a) - by_chance
        return bool((moved[:6] <= _LIMITS.drifts[:6]).all())  # of the acceleration the pose was compared

    def _end_period(self) -> None:
        held, self._held = self._held, []
        if len(held) < 3 or not self._start[0]:
            return
        rows = np.concatenate(held[1:-1])
        first_s, last_s = rows[[0, -1], _TIME].tolist()
        if last_s - first_s < self._least_s:
            return
        try:
            means = stationary_means(rows[:, _ROW], _LIMITS)
        except NotStationaryError as error:
            self.rejected.append(f"{first_s:.1f} s to {last_s:.1f} s: {error}")
        else:
            means = means._replace(time_s=first_s + 0.5 * (last_s - first_s))
            self.periods.append(StationaryPeriod(first_s, last_s - first_s, means))
