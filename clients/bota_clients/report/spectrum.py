"""Spectra by Welch's method, of the longest uninterrupted part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bota_clients.report.series import Floats, Series

RESOLUTION_S: Final = 2.0
"""Length of a segment: a resolution of half a hertz."""
_SHORTEST: Final = 64
"""Minimum number of samples."""
MOST_FILLED: Final = 3
"""Longest run of missing samples that is interpolated."""


@dataclass(frozen=True)
class Spectrum:
    """Amplitude spectral density of all channels."""

    frequency: Floats
    """(k,) Hz, without 0"""
    density: Floats
    """(k, 12) unit/√Hz; NaN for a channel that is constant or has no finite values"""
    segments: int
    """Number of half-overlapping segments averaged."""
    span_s: float
    """Duration of the part that they come from."""
    filled: int
    """Number of missing samples that were interpolated."""
    resolution_hz: float


def measure(series: Series) -> Spectrum | None:
    """The spectra; None if no uninterrupted part is long enough."""
    if series.count < _SHORTEST:
        return None
    gap = series.silent | (series.missing > MOST_FILLED) | (series.intervals <= 0)
    gap |= series.intervals > (MOST_FILLED + 1.5) * series.period
    edges = np.concatenate(([0], np.flatnonzero(gap) + 1, [series.count]))
    longest = int(np.argmax(np.diff(edges)))
    start, end = int(edges[longest]), int(edges[longest + 1])
    # On a regular grid, with missing samples interpolated.
    indices = np.concatenate(([0], np.cumsum(1 + series.missing[start : end - 1])))
    count = int(indices[-1]) + 1
    if count < _SHORTEST:
        return None
    # A power of two near the resolution; a short stretch is still averaged a few times.
    wanted = 2 ** round(np.log2(max(_SHORTEST, RESOLUTION_S / series.period)))
    length = max(_SHORTEST, min(wanted, 2 ** int(np.log2(max(1, count // 4)))))
    values, finite = series.values[start:end], series.finite[start:end]
    density = np.full((length // 2, values.shape[1]), np.nan)
    measured = False
    grid = np.arange(count)
    for channel in range(values.shape[1]):
        column = values[:, channel]
        good = finite[:, channel]
        if np.count_nonzero(good) < _SHORTEST or np.ptp(column[good]) == 0:
            continue
        even = np.interp(grid, indices[good], column[good])
        density[:, channel] = np.sqrt(welch(even, series.rate, length)[1:])
        measured = True
    if not measured:
        return None
    segments = 1 + (count - length) // (length // 2)
    frequency = np.arange(1, length // 2 + 1) * (series.rate / length)
    return Spectrum(frequency, density, segments, count * series.period, count - (end - start),
                    series.rate / length)  # fmt: skip


def welch(values: Floats, rate: float, length: int) -> Floats:
    """(length // 2 + 1,) one-sided power spectral density in unit²/Hz by Welch's method.

    `values` are at least `length`, which is even, at `rate` in Hz. Segments overlap by half; from each, a
    straight line is subtracted before a Hann window is applied. Never 0, for a logarithmic scale.
    """
    segments = sliding_window_view(values, length)[:: length // 2]
    time = np.arange(length) - (length - 1) / 2
    segments = segments - segments.mean(axis=1, keepdims=True)
    segments -= np.outer(segments @ time / (time @ time), time)
    window = np.hanning(length + 1)[:-1]
    power = (np.abs(np.fft.rfft(segments * window)) ** 2).mean(axis=0) / (rate * (window @ window))
    power[1:-1] *= 2
    density: Floats = np.maximum(power, np.finfo(float).tiny)
    return density
