"""Reduces long series for a plot without losing a spike: minimum, maximum and mean of each bin."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from clients.report.subjects.series import Bools, Floats

BINS: Final = 640
"""About the width of a page in points."""


class Envelope(NamedTuple):
    """m bins; NaN in empty bins."""

    time: Floats
    """(m,) s, the middle of each bin"""
    low: Floats
    high: Floats
    mean: Floats


def envelope(time: Floats, values: Floats, begin: float, end: float, bins: int = BINS) -> Envelope:
    """Of samples at `time` (s), which need not be in order; values that are not finite are ignored."""
    good = np.isfinite(values)
    time, values = time[good], values[good]
    edges = np.linspace(begin, end, bins + 1)
    index = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, bins - 1)
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    np.minimum.at(low, index, values)
    np.maximum.at(high, index, values)
    counts = np.bincount(index, minlength=bins)
    filled = counts > 0
    mean = np.full(bins, np.nan)
    mean[filled] = np.bincount(index, weights=values, minlength=bins)[filled] / counts[filled]
    low[~filled] = high[~filled] = np.nan
    return Envelope((edges[:-1] + edges[1:]) / 2, low, high, mean)


def stretches(times: Floats, width: float, bins: int = BINS) -> Floats:
    """(k, 2) where something happened at `times` (s): the bins of 0 to `width`, neighbours as one stretch."""
    if not len(times):
        return np.zeros((0, 2))
    indices = np.unique(np.clip((times / width * bins).astype(np.int64), 0, bins - 1))
    apart = np.diff(indices) > 1
    starts, ends = indices[np.append(True, apart)], indices[np.append(apart, True)] + 1
    return np.column_stack([starts, ends]) * (width / bins)


def interrupted(time: Floats, values: Floats, broken: Bools) -> tuple[Floats, Floats]:
    """A line that is interrupted where the series is, by NaN."""
    indices = np.flatnonzero(broken) + 1
    return np.insert(time, indices, np.nan), np.insert(values, indices, np.nan)
