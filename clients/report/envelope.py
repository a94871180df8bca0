"""Long series made short for a plot without losing a spike: least, greatest and mean of each bin."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from clients.report.series import Bools, Floats

BINS: Final = 640
"""About as many as a page is wide in points."""


class Envelope(NamedTuple):
    """m bins; NaN where there is no sample in one."""

    time: Floats
    """(m,) s, the middle of each bin"""
    low: Floats
    high: Floats
    mean: Floats


def envelope(time: Floats, values: Floats, begin: float, end: float, bins: int = BINS) -> Envelope:
    """Of samples at `time` (s), which need not be in order; values that are not finite are left out."""
    good = np.isfinite(values)
    time, values = time[good], values[good]
    edges = np.linspace(begin, end, bins + 1)
    place = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, bins - 1)
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    np.minimum.at(low, place, values)
    np.maximum.at(high, place, values)
    counts = np.bincount(place, minlength=bins)
    filled = counts > 0
    mean = np.full(bins, np.nan)
    mean[filled] = np.bincount(place, weights=values, minlength=bins)[filled] / counts[filled]
    low[~filled] = high[~filled] = np.nan
    return Envelope((edges[:-1] + edges[1:]) / 2, low, high, mean)


def stretches(times: Floats, width: float, bins: int = BINS) -> Floats:
    """(k, 2) where something happened at `times` (s): the bins of 0 to `width`, neighbours as one stretch."""
    if not len(times):
        return np.zeros((0, 2))
    places = np.unique(np.clip((times / width * bins).astype(np.int64), 0, bins - 1))
    apart = np.diff(places) > 1
    starts, ends = places[np.append(True, apart)], places[np.append(apart, True)] + 1
    return np.column_stack([starts, ends]) * (width / bins)


def interrupted(time: Floats, values: Floats, broken: Bools) -> tuple[Floats, Floats]:
    """A line that is broken where the series is: NaN between the samples on either side."""
    places = np.flatnonzero(broken) + 1
    return np.insert(time, places, np.nan), np.insert(values, places, np.nan)
