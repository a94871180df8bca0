"""Finds the periods of a recording in which the sensor was stationary.

The recording is divided into short blocks. Quiet blocks in a row with the same pose make a period. Its first
and last block, in which a hand may have touched it or the robot may have swung, are excluded; the remainder
must pass the same test as a pose that is taken live.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np

from bota_clients.recording.columns import Columns, Floats
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


_TIME, _ROW, _GOOD = 0, slice(1, 13), 13  # columns of a table of samples


def tables_of(batches: Iterable[Columns]) -> Iterator[Floats]:
    """Of the new samples of each batch a table (n, 14), that of a batch without samples left out.

    Times, s since the first sample; force, torque, acceleration, angular rate, 0 where they may not be used;
    whether they may be used.
    """
    begin_ns = None
    for batch in batches:
        fresh = batch.where(batch.fresh)
        if not len(fresh):
            continue
        begin_ns = int(fresh.monotonic_ns[0]) if begin_ns is None else begin_ns
        rows = np.hstack([fresh.force, fresh.torque, fresh.acceleration, fresh.angular_rate])
        flagged = sum(channel.flagged(fresh) for channel in (FORCE_TORQUE, ACCELERATION, ANGULAR_RATE))
        good = np.isfinite(rows).all(axis=1) & (flagged == 0)
        rows[~good] = 0.0
        yield np.column_stack([(fresh.monotonic_ns - begin_ns) * 1e-9, rows, good])


def usable(table: Floats) -> Floats:
    """(k, 13) the samples of a table that may be used: times and values."""
    return table[table[:, _GOOD] > 0, :_GOOD]


class StationaryPeriods:
    """Finds the periods of at least `least_s` while tables of samples come; holds those of the latest one.

    Attributes:
        found: the periods, in order.
        rejected: sentences about those that nearly are.
    """

    def __init__(self, least_s: float = LEAST_S) -> None:
        self.found, self.rejected = list[StationaryPeriod](), list[str]()
        self._least_s = least_s
        self._rest, self._held = np.zeros((0, 14)), list[Floats]()  # of no whole block yet; of the period
        self._size = 0  # samples in a block; 0: to be told by the first ones of the stretch
        self._last_s = -math.inf

    def add(self, table: Floats) -> None:
        """The next of `tables_of`."""
        for part in stretches(np.append(self._last_s, table[:, _TIME]), GAP_S):
            if part.start:
                self.end_stretch()
            self._rest = np.concatenate([self._rest, table[max(part.start - 1, 0) : part.stop - 1]])
            if self._size or len(self._rest) >= _ENOUGH:
                self._take()
        self._last_s = float(table[-1, _TIME])

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
            if not (quiet[number] and self._continues(mean[number], deviation[number])):
                self._end_period()
                self._start = mean[number], deviation[number]
            if quiet[number]:
                self._held.append(blocks[number])

    def _continues(self, mean: Floats, deviation: Floats) -> bool:
        """Whether a quiet block belongs to the period that goes on."""
        if not self._held or len(self._held) * self._size >= _MOST_SAMPLES:
            return False
        at_first, its_deviation = self._start
        sizes = float(np.linalg.norm(at_first[6:9]) * np.linalg.norm(mean[6:9]))
        if float(at_first[6:9] @ mean[6:9]) < _SAME_POSE * sizes:
            return False
        by_chance = CHANCE * (its_deviation + deviation) / math.sqrt(self._size)
        moved = np.abs(mean - at_first) - by_chance
        return bool((moved[:6] <= _LIMITS.drifts[:6]).all())  # of the acceleration the pose was compared

    def _end_period(self) -> None:
        held, self._held = self._held, []
        if len(held) < 3:
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
            self.found.append(StationaryPeriod(first_s, last_s - first_s, means))
