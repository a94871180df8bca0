"""The plots of the page, as pictures in it. No text from a device is drawn."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any, Final

import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bota_clients.numbers import figure as number
from bota_clients.numbers import seconds
from bota_clients.recording.columns import Bools, Floats
from bota_clients.report.series import GROUPS, Group, Series

# Those of the axes differ in lightness as well as in hue (after Okabe and Ito).
AXES: Final = ("#c44601", "#00795c", "#1763c6")
INK, MUTED, GRID, BAD, LIMIT, PLAIN = "#1b1f24", "#5b6570", "#e3e7eb", "#b3201b", "#7a3e9d", "#5d7896"

STYLE: Final[dict[str, Any]] = {
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "text.color": INK,
    "text.parse_math": False,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.formatter.useoffset": False,
    "figure.facecolor": "none",
    "figure.figsize": (9.0, 4.3),  # inches
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.0,
}

_DPI: Final = 120


def draw(paint: Callable[..., str], *arguments: Any) -> tuple[str, str] | None:
    """The figure that one of the functions below paints from `arguments`, as a data URL, and what it shows.

    None if it has nothing to show.
    """
    with mpl.style.context(STYLE, after_reset=True):
        figure = Figure()
        FigureCanvasAgg(figure)
        if not (description := paint(figure, *arguments)):
            return None
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}", description


def _margins(figure: Figure, **space: float) -> None:
    """Fixed margins around the axes, in inches above and below, independent of fonts."""
    height = figure.get_figheight()
    figure.subplots_adjust(left=0.09, right=0.985, top=1 - 0.08 / height, bottom=0.44 / height, **space)


def _panels(figure: Figure, series: Series) -> list[Axes]:
    """Three axes above one another that share the time axis, aligned in all figures."""
    _margins(figure, hspace=0.13)
    panels = list(figure.subplots(3, 1, sharex=True))
    for panel in panels:
        panel.yaxis.set_label_coords(-0.072, 0.5)
    panels[-1].set(xlim=(0, series.width), xlabel="time, s")
    return panels


def stretches(bins: Bools, width: float) -> Floats:
    """(k, 2) the marked bins of 0 to `width`, neighbours as one stretch."""
    edges = np.flatnonzero(np.diff(bins, prepend=False, append=False))
    return np.multiply(edges.reshape(-1, 2), width / len(bins))


def _segments(panel: Axes, ends: Floats, heights: tuple[float, float], **style: Any) -> None:
    """A line for each of `ends` (k, 2), all as one path, between these heights."""
    time = np.column_stack([ends, ends[:, 1]]).ravel()
    panel.plot(time, np.tile([*heights, np.nan], len(ends)), solid_capstyle="butt", **style)


def over_time(figure: Figure, series: Series, group: Group) -> str:
    """Three panels, x, y and z: mean and range of each bin; marks where it was saturated or lost samples."""
    texts = []
    envelope, few = series.envelope, series.few
    lost = stretches(series.lossy, series.width).mean(axis=1, keepdims=True)
    for axis, panel in enumerate(_panels(figure, series)):
        index = 3 * GROUPS.index(group) + axis
        low, high, in_panel = envelope.low[:, index], envelope.high[:, index], panel.get_xaxis_transform()
        panel.set_ylabel(f"{'xyz'[axis]}, {group.unit}")
        known = np.isfinite(low)
        if not known.any():
            panel.text(0.5, 0.5, "no data", transform=panel.transAxes, ha="center", color=MUTED)
        elif few:
            times, rows, apart = zip(*few, strict=True)
            at, values = np.flatnonzero(apart), np.array(rows)[:, index]  # where the line is interrupted
            values = np.where(np.isfinite(values), values, np.nan)
            panel.plot(np.insert(times, at, np.nan), np.insert(values, at, np.nan), color=AXES[axis])
        else:
            panel.fill_between(envelope.middles, low, high, color=AXES[axis], alpha=0.35, linewidth=0.4)
            panel.plot(envelope.middles, envelope.mean[:, index], color=AXES[axis], linewidth=0.8)
        saturated = stretches(series.saturated[:, index], series.width)
        _segments(panel, saturated, (0.985, 0.985), color=BAD, linewidth=3, transform=in_panel)
        _segments(panel, np.tile(lost, 2), (0.0, 0.07), color=INK, linewidth=0.7, transform=in_panel)
        if known.any():
            least, most = number(np.nanmin(low)), number(np.nanmax(high))
            texts.append(f"{'xyz'[axis]} from {least} to {most}")
    return f"{group.title} in {group.unit} over {seconds(series.duration)}: {', '.join(texts) or 'nothing'}."


def temperature(figure: Figure, series: Series) -> str:
    """The mean of each bin."""
    mean = series.envelope.mean[:, -1]
    known = np.isfinite(mean)
    if series.temperatures is None:
        return ""
    figure.set_figheight(2.0)
    _margins(figure)
    panel = figure.subplots()
    panel.plot(series.envelope.middles[known], mean[known], color=PLAIN)
    panel.set(xlim=(0, series.width), xlabel="time, s", ylabel="°C")
    return f"Temperature from {number(series.temperatures[0])} to {number(series.temperatures[1])} °C."
