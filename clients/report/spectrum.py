"""Spectra by Welch's method, of the longest stretch without an interruption."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import welch

from clients.report.series import Floats, Series

RESOLUTION_S: Final = 2.0
"""Length of a segment: half a hertz."""
_SHORTEST: Final = 64
"""Samples."""
MOST_FILLED: Final = 3
"""So many missing samples in a row are filled in by a straight line."""


@dataclass(frozen=True)
class Spectrum:
    """Amplitude spectral density of all channels."""

    frequency: Floats
    """(k,) Hz, without 0"""
    density: Floats
    """(k, 12) unit/√Hz; NaN for a channel that stands still or has no numbers"""
    segments: int
    """So many half-overlapping segments were averaged."""
    span_s: float
    """The stretch that they come from."""
    filled: int
    """Samples that were missing in it and were filled in."""
    resolution_hz: float


def measure(series: Series) -> Spectrum | None:
    """None if no stretch is long enough."""
    if series.count < _SHORTEST:
        return None
    gap = series.silent | (series.missing > MOST_FILLED) | (series.intervals <= 0)
    gap |= series.intervals > (MOST_FILLED + 1.5) * series.period
    edges = np.concatenate(([0], np.flatnonzero(gap) + 1, [series.count]))
    longest = int(np.argmax(np.diff(edges)))
    start, end = int(edges[longest]), int(edges[longest + 1])
    # On an even grid: the samples by number, what is missing between them on a straight line.
    places = np.concatenate(([0], np.cumsum(1 + series.missing[start : end - 1])))
    count = int(places[-1]) + 1
    if count < _SHORTEST:
        return None
    # A power of two near the resolution; a short stretch is still averaged a few times.
    wanted = 2 ** round(np.log2(max(_SHORTEST, RESOLUTION_S / series.period)))
    length = max(_SHORTEST, min(wanted, 2 ** int(np.log2(max(1, count // 4)))))
    values, finite = series.values[start:end], series.finite[start:end]
    density = np.full((length // 2, values.shape[1]), np.nan)
    frequency = np.zeros(0)
    grid = np.arange(count)
    for channel in range(values.shape[1]):
        column = values[:, channel]
        good = finite[:, channel]
        if np.count_nonzero(good) < _SHORTEST or np.ptp(column[good]) == 0:
            continue
        even = np.interp(grid, places[good], column[good])
        frequency, power = welch(even, series.rate, nperseg=length, detrend="linear")
        # The smallest positive number where there is none, so that it can be drawn on a logarithmic scale.
        density[:, channel] = np.sqrt(np.maximum(power[1:], np.finfo(float).tiny))
    if not len(frequency):
        return None
    segments = 1 + (count - length) // (length // 2)
    return Spectrum(frequency[1:], density, segments, count * series.period, count - (end - start),
                    series.rate / length)  # fmt: skip
