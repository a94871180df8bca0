# SPDX-License-Identifier: Apache-2.0
"""Samples on even grids, one for each stretch without a gap.

So memory follows from the samples: the time between two of them is whatever a file says.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GAP_S: Final = 0.5  # samples further apart do not belong together
_GAP_PERIODS: Final = 5.0  # of slow ones


def stretches(times: NDArray[Any], gap: float) -> list[slice]:
    """The parts in which times ascend by at most `gap`."""
    steps = np.diff(times)
    breaks = np.flatnonzero(~((steps > 0) & (steps <= gap))) + 1
    return [slice(*ends) for ends in pairwise([0, *breaks.tolist(), len(times)]) if ends[1] > ends[0]]


def resampled(times: Array, columns: Array, least_s: float) -> tuple[float, list[tuple[Array, Array]]]:
    """The usual period; of each stretch over `least_s`, even times so far apart and `columns` there."""
    period = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    parts = stretches(times, max(GAP_S, _GAP_PERIODS * period))
    parts = [part for part in parts if times[part.stop - 1] - times[part.start] > least_s]
    grids = [np.arange(times[part.start], times[part.stop - 1], period) for part in parts]
    rows = zip(grids, parts, strict=True)
    return period, [(grid, at_times(grid, times[part], columns[part])) for grid, part in rows]


def hann_window(seconds: float, period: float) -> Array:
    window = np.hanning(max(3, round(seconds / period) | 1) + 2)[1:-1]
    return np.asarray(window / window.sum())


def smoothed(columns: Array, window: Array, mode: Literal["same", "full"] = "same") -> Array:
    return np.stack([np.convolve(column, window, mode) for column in columns.T], axis=1)


def at_times(instants: Array, times: Array, columns: Array) -> Array:
    return np.stack([np.interp(instants, times, column) for column in columns.T], axis=1)
