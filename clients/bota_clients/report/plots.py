"""The plots of the page, as pictures in it (SVG). No text from a device is drawn."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from bota_clients.numbers import figure as number
from bota_clients.numbers import seconds
from bota_clients.recording.columns import Bools, Floats
from bota_clients.report.series import GROUPS, Group, Series

# Those of the axes differ in lightness as well as in hue (after Okabe and Ito).
AXES: Final = ("#c44601", "#00795c", "#1763c6")
INK, MUTED, GRID, BAD, PLAIN = "#1b1f24", "#5b6570", "#e3e7eb", "#b3201b", "#5d7896"
# Of the picture, in its units: the margins around the panels, how high one is and how far from the next.
_WIDTH, _LEFT, _RIGHT, _TOP, _BELOW, _HEIGHT, _APART = 900, 81.0, 886.0, 8, 44, 116, 15
_BIN: Final = 1.5  # how wide one is: without a seam to the next


def draw(paint: Callable[..., str], *arguments: Any) -> tuple[str, str] | None:
    """The plot that one of the functions below paints from `arguments`, as a data URL, and what it shows.

    None if it has nothing to show.
    """
    plot = _Plot()
    if not (description := paint(plot, *arguments)):
        return None
    return f"data:image/svg+xml;base64,{base64.b64encode(plot.svg().encode()).decode()}", description


class _Plot:
    """Panels above one another that share the time axis."""

    def __init__(self) -> None:
        self._parts, self._top = list[str](), float(_TOP - _APART - _HEIGHT)  # of the last panel

    def svg(self) -> str:
        self._text(0.5 * (_LEFT + _RIGHT), self._top + _HEIGHT + 38, "time, s")
        for tick in self._times:
            self._text(self._x(tick), self._top + _HEIGHT + 16, f"{tick:.10g}")
        size = f"{_WIDTH} {self._top + _HEIGHT + _BELOW:g}"
        style = f'viewBox="0 0 {size}" font-family="DejaVu Sans, sans-serif" font-size="12" fill="{INK}"'
        return f'<svg xmlns="http://www.w3.org/2000/svg" {style}>{"".join(self._parts)}</svg>'

    def begin(self, label: str, low: Floats, high: Floats, width_s: float) -> bool:
        """A panel for values from the least of `low` to the largest of `high`; whether there are any."""
        known = bool(np.isfinite(low).any())
        least, most = (float(np.nanmin(low)), float(np.nanmax(high))) if known else (0.0, 0.0)
        more = 0.05 * (most - least) or 0.05 * abs(most) or 1.0
        self._low, self._span, self._width_s = least - more, most - least + 2 * more, width_s
        self._top += _HEIGHT + _APART
        self._times, values = _ticks(0.0, width_s, 10), _ticks(self._low, self._low + self._span, 5)
        self.segments(np.tile(self._times, (2, 1)).T, (0.0, 1.0), GRID, 0.7)
        self.segments((0.0, width_s), self._share(np.tile(values, (2, 1)).T), GRID, 0.7)
        self.segments([[0.0, width_s], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], MUTED, 0.8)
        middle = self._top + 0.5 * _HEIGHT
        for tick in values:
            self._text(_LEFT - 6, self._y(self._share(tick)) + 4, f"{tick:.10g}", "end")
        self._text(23, middle, label, more=f' transform="rotate(-90 23 {middle:g})"')
        if not known:
            self._text(0.5 * (_LEFT + _RIGHT), middle, "no data", more=f' fill="{MUTED}"')
        return known

    def line(self, times: Floats, values: Floats, color: str) -> None:
        """Interrupted where a value is not finite."""
        self._path(times, self._share(values), color, 1.3)

    def bars(self, times: Floats, low: Floats, high: Floats, color: str) -> None:
        heights = self._share(np.column_stack([low, high]))
        self.segments(np.tile(times, (2, 1)).T, heights, color, _BIN, ' stroke-opacity="0.35"')

    def segments(self, times: Any, heights: Any, color: str, width: float, more: str = "") -> None:
        """Lines (n, 2) from and to these times and heights, 0 to 1 in the panel."""
        times, heights = np.broadcast_arrays(np.atleast_2d(times), np.atleast_2d(heights))
        x, y = (np.insert(each, 2, np.nan, axis=1).ravel() for each in (times, heights))
        self._path(x, y, color, width, more)

    def _path(self, times: Floats, heights: Floats, color: str, width: float, more: str = "") -> None:
        known = np.isfinite(heights)
        x, y = self._x(times[known]).tolist(), self._y(heights[known]).tolist()
        commands = np.where(np.diff(known, prepend=False)[known], "M", "L").tolist()
        d = "".join(map("{}{:.1f} {:.1f}".format, commands, x, y))
        self._parts.append(f'<path d="{d}" fill="none" stroke="{color}" stroke-width="{width}"{more}/>')

    def _text(self, x: float, y: float, text: str, anchor: str = "middle", more: str = "") -> None:
        self._parts.append(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{text}</text>')

    def _x(self, times: Any) -> Any:
        return _LEFT + times / self._width_s * (_RIGHT - _LEFT)

    def _share(self, values: Any) -> Any:
        return (np.asarray(values) - self._low) / self._span

    def _y(self, heights: Any) -> Any:
        return self._top + _HEIGHT * (1 - heights)


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers from `low` to `high`, about so many at most."""
    rough = (high - low) / most
    step = 10.0 ** math.floor(math.log10(rough))
    step *= next(each for each in (1, 2, 5, 10) if each == 10 or each * step >= rough)
    return [each * step for each in range(math.ceil(low / step), math.floor(high / step) + 1)]


def stretches(bins: Bools, width: float) -> Floats:
    """(k, 2) the marked bins of 0 to `width`, neighbours as one stretch."""
    edges = np.flatnonzero(np.diff(bins, prepend=False, append=False))
    return np.multiply(edges.reshape(-1, 2), width / len(bins))


def over_time(plot: _Plot, series: Series, group: Group) -> str:
    """Three panels, x, y and z: mean and range of each bin; marks where it was saturated or lost samples."""
    texts = []
    bins, saturated = series.bins, series.saturated(group)
    lost = stretches(bins.flags[-1] > 0, series.width).mean(axis=1, keepdims=True)
    for axis, color in enumerate(AXES):
        index = 3 * GROUPS.index(group) + axis
        low, high = bins.low[index], bins.high[index]
        known = plot.begin(f"{'xyz'[axis]}, {group.unit}", low, high, series.width)
        if known and series.few:
            times, rows, _, _, is_apart = map(np.concatenate, zip(*series.few, strict=True))
            at = np.flatnonzero(is_apart)  # where the line is interrupted
            plot.line(np.insert(times, at, 0.0), np.insert(rows[:, index], at, np.nan), color)
        elif known:
            plot.bars(bins.middles, low, high, color)
            plot.line(bins.middles, bins.mean[index], color)
        plot.segments(stretches(saturated[axis], series.width), (0.985, 0.985), BAD, 4)
        plot.segments(np.tile(lost, 2), (0.0, 0.07), INK, 1)
        if known:
            least, most = number(np.nanmin(low)), number(np.nanmax(high))
            texts.append(f"{'xyz'[axis]} from {least} to {most}")
    return f"{group.title} in {group.unit} over {seconds(series.duration)}: {', '.join(texts) or 'nothing'}."


def temperature(plot: _Plot, series: Series) -> str:
    """The mean of each bin."""
    mean = series.bins.mean[-1]
    if series.temperatures is None:
        return ""
    known = np.isfinite(mean)
    plot.begin("°C", mean, mean, series.width)
    plot.line(series.bins.middles[known], mean[known], PLAIN)
    return f"Temperature from {number(series.temperatures[0])} to {number(series.temperatures[1])} °C."
