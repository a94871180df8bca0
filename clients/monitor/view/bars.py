"""Draws one value as a bar about zero with its peaks, and its past as a trace in one line."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from typing import Final

from rich.text import Text

from clients.monitor.model.state import Range
from clients.monitor.view.glyphs import BAR, LABEL, PEAK, TRACK, Glyphs

_STEPS: Final = (1.0, 2.0, 3.0, 5.0, 10.0)
_QUIET: Final = 0.05
"""Smallest scale of a trace, relative to the bar's, so that noise does not look like a signal."""


def scale_for(ranges: Iterable[Range], least: float) -> float:
    """The full scale that shows all of `ranges`: 1, 2, 3 or 5 times a power of ten, at least
    `least`."""
    reach = max((abs(value) for r in ranges for value in r if math.isfinite(value)), default=0.0)
    if reach <= least:
        return least
    power = 10.0 ** math.floor(math.log10(reach))
    return next((step * power for step in _STEPS if step * power >= reach), 10.0 * power)


def bar(value: float, peak: Range | None, scale: float, width: int, glyphs: Glyphs) -> Text:
    """A bar of `width` cells, with zero in the middle and `scale` at either end."""
    zero = width // 2
    cells = [glyphs.track] * width
    styles = [TRACK] * width
    cells[zero], styles[zero] = glyphs.zero, LABEL
    halves = 0
    if math.isfinite(value):
        halves = round(min(1.0, abs(value) / scale) * 2 * zero)
    step = 1 if value >= 0 else -1
    partial = glyphs.half_left if step > 0 else glyphs.half_right
    whole = halves // 2 if partial else round(halves / 2)
    for n in range(1, whole + 1):
        cells[zero + step * n], styles[zero + step * n] = glyphs.full, BAR
    if partial and halves % 2:
        cells[zero + step * (whole + 1)], styles[zero + step * (whole + 1)] = partial, BAR
    if peak is not None:
        for extreme, mark in ((peak.low, glyphs.low), (peak.high, glyphs.high)):
            if math.isfinite(extreme):
                at = zero + round(max(-1.0, min(1.0, extreme / scale)) * zero)
                cells[at], styles[at] = mark, PEAK
    return joined(cells, styles)


def trace(past: Sequence[Range | None], scale: float, width: int, glyphs: Glyphs) -> str:
    """The last `width` time steps; of each the value furthest from the median."""
    return traces(past, scale, width, 1, glyphs)[0]


def traces(
    past: Sequence[Range | None], scale: float, width: int, height: int, glyphs: Glyphs
) -> list[str]:  # fmt: skip
    """The same on `height` rows, the top first."""
    shown = list(past[-width:]) if width else []
    known = [r for r in shown if r is not None]
    if not known:
        return [" " * width] * height
    low, high = min(r.low for r in known), max(r.high for r in known)
    middle, usual = (low + high) / 2, statistics.median((r.low + r.high) / 2 for r in known)
    half = max((high - low) / 2, _QUIET * scale / 2)
    steps = len(glyphs.levels)
    drawn = []
    for piece in shown:
        if piece is None:
            drawn.append(" " * height)
            continue
        value = piece.high if piece.high - usual >= usual - piece.low else piece.low
        full, rest = divmod(round((value - middle + half) / (2 * half) * (height * steps - 1)), steps)
        column = glyphs.full * full + glyphs.levels[rest]
        drawn.append(column[:height].ljust(height))
    return ["".join(column[row] for column in drawn).rjust(width) for row in reversed(range(height))]


def joined(cells: Sequence[str], styles: Sequence[str]) -> Text:
    """The cells as one text; neighbors of one style are one span."""
    text = Text(no_wrap=True)
    start = 0
    for n in range(1, len(cells) + 1):
        if n == len(cells) or styles[n] != styles[start]:
            text.append("".join(cells[start:n]), styles[start])
            start = n
    return text
