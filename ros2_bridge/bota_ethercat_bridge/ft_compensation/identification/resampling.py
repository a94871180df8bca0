# SPDX-License-Identifier: Apache-2.0
"""Samples on even grids, one for each stretch without a gap.

So memory follows from the samples: the time between two of them is whatever a file says.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def stretches(times: NDArray[Any], gap: float) -> list[slice]:
    """The parts in which times ascend by at most `gap`."""
    steps = np.diff(times)
    breaks = np.flatnonzero(~((steps > 0) & (steps <= gap))) + 1
    return [slice(*ends) for ends in pairwise([0, *breaks.tolist(), len(times)]) if ends[1] > ends[0]]


def resampled(
    times: Array, columns: Array, period: float, gap_s: float, least_s: float = 0.0
) -> list[tuple[Array, Array]]:
    """Even times, and `columns` (n, k) at these, of each stretch that is longer than `least_s`."""
    parts = [part for part in stretches(times, gap_s) if times[part.stop - 1] - times[part.start] > least_s]
    grids = [np.arange(times[part.start], times[part.stop - 1], period) for part in parts]
    return [
        (grid, at_times(grid, times[part], columns[part])) for grid, part in zip(grids, parts, strict=True)
    ]


def hann_window(seconds: float, period: float) -> Array:
    window = np.hanning(max(3, round(seconds / period) | 1) + 2)[1:-1]
    return np.asarray(window / window.sum())


def smoothed(columns: Array, window: Array, mode: Literal["same", "full"] = "same") -> Array:
    return np.stack([np.convolve(column, window, mode) for column in columns.T], axis=1)


def at_times(instants: Array, times: Array, columns: Array) -> Array:
    return np.stack([np.interp(instants, times, column) for column in columns.T], axis=1)
