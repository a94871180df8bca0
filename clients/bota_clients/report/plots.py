"""The plots of the page, as inline SVG: colors as CSS variables, text as text, reproducible.

Figures are drawn in placeholder colors, which become CSS variables: the style sheet defines `--ink` or
`--x` for light, dark and print. No text from a device is drawn.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from bota_clients.numbers import count, seconds
from bota_clients.numbers import figure as number
from bota_clients.report import checks
from bota_clients.report.checks import Drift, Noise, Timing
from bota_clients.report.series import CHANNELS, GROUPS, Bools, Floats, Group, Series
from bota_clients.report.spectrum import Spectrum
from bota_ethercat.framing import DataFlag
from bota_ethercat.sensor.meaning import meaning

INK, MUTED, GRID = "#010101", "#010102", "#010103"
X, Y, Z = "#020101", "#020102", "#020103"
BAD, LIMIT, PLAIN = "#030101", "#030102", "#030103"
AXES: Final = (X, Y, Z)
DASHES: Final[tuple[str, ...]] = ("-", "--", ":")
"""Line styles of x, y and z, so that nothing depends on color."""
_VARIABLES: Final = {
    INK: "--ink", MUTED: "--muted", GRID: "--grid", X: "--x", Y: "--y", Z: "--z",
    BAD: "--bad", LIMIT: "--limit", PLAIN: "--plain",
}  # fmt: skip

STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "ethercat-report",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.labelsize": 8.5,
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
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.formatter.useoffset": False,
    "figure.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.0,
    "path.simplify_threshold": 0.2,
    "agg.path.chunksize": 0,
}
WIDTH_IN: Final = 9.0

_DROPPED: Final = re.compile(
    r"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>|<style type=\"text/css\">.*?</style>",
    re.DOTALL,
)
_OPENING: Final = re.compile(r"<svg\b[^>]*?(viewBox=\"[^\"]*\")[^>]*>", re.DOTALL)
_COLOR: Final = re.compile("|".join(_VARIABLES))
_PATH: Final = re.compile(r'\bd="([^"]*)"')
_NUMBER: Final = re.compile(r"-?\d+\.\d+")
_IDENTIFIER: Final = re.compile(r'(\bid="|url\(#|href="#)')
_FONT_FAMILY: Final = re.compile(r"'?DejaVu Sans'?(, sans-serif)*")


def draw(name: str, title: str, description: str, height_in: float, paint: Callable[[Figure], None]) -> str:
    """The SVG of a figure that `paint` fills; `name` must be unique in the page.

    `title` and `description` are for screen readers.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        figure = Figure(figsize=(WIDTH_IN, height_in))
        FigureCanvasSVG(figure)
        paint(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return _inline(buffer.getvalue(), name, title, description)


def _inline(svg: str, name: str, title: str, description: str) -> str:
    svg = _DROPPED.sub("", svg)
    svg = _PATH.sub(lambda m: f'd="{_NUMBER.sub(_rounded, " ".join(m[1].split()))}"', svg)
    svg = _IDENTIFIER.sub(rf"\1{name}-", svg)
    svg = _COLOR.sub(lambda m: f"var({_VARIABLES[m[0]]})", svg)
    svg = _FONT_FAMILY.sub("var(--font)", svg)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" {{box}} '
        f'role="img" '
        f'aria-labelledby="{name}-title {name}-desc">'
        f'<title id="{name}-title">{html.escape(title)}</title>'
        f'<desc id="{name}-desc">{html.escape(description)}</desc>'
    )
    svg = _OPENING.sub(lambda m: head.format(box=m[1]), svg, count=1)
    return re.sub(r"\n\s*\n+", "\n", re.sub(r"[ \t]+\n", "\n", re.sub(r"\n +", "\n", svg))).strip()


def _rounded(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}".rstrip("0").rstrip(".")


def margins(
    figure: Figure, *, left: float = 0.09, top_in: float = 0.08, hspace: float = 0.2, wspace: float = 0.2
) -> None:
    """Fixed margins around the axes, independent of fonts; `top_in` in inches."""
    height = figure.get_figheight()
    figure.subplots_adjust(
        left=left, right=0.985, top=1 - top_in / height, bottom=0.44 / height, hspace=hspace, wspace=wspace
    )


def rows(figure: Figure, count: int) -> list[Axes]:
    """`count` axes above one another that share the time axis, aligned in all figures."""
    margins(figure, hspace=0.13)
    made = [row[0] for row in figure.subplots(count, 1, sharex=True, squeeze=False)]
    for panel in made:
        panel.yaxis.set_label_coords(-0.072, 0.5)
    return made


def plain_log(panel: Axes) -> None:
    """Label the decades of both axes with plain numbers instead of exponents."""
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


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


_DENSE: Final = 2 * BINS
"""More samples than this are drawn as an envelope."""


def over_time(series: Series, group: Group, name: str) -> str:
    """Three panels, x, y and z: mean and range of each bin; marks where it was saturated or lost samples."""
    first = 3 * GROUPS.index(group)
    texts = []

    def paint(figure: Figure) -> None:
        axes = rows(figure, 3)
        for axis, panel in enumerate(axes):
            values = series.values[:, first + axis]
            _trace(panel, series, values, AXES[axis])
            _marks(panel, series, first + axis)
            panel.set_ylabel(f"{'xyz'[axis]}, {group.unit}")
            panel.set_xlim(0, max(series.duration, series.period))
        axes[-1].set_xlabel("time, s")

    for axis in range(3):
        values = series.values[:, first + axis]
        values = values[np.isfinite(values)]
        if len(values):
            texts.append(f"{'xyz'[axis]} from {number(float(values.min()))} to {number(float(values.max()))}")
    description = (
        f"{group.title} in {group.unit} over {seconds(series.duration)}: {', '.join(texts) or 'nothing'}."
    )
    return draw(name, f"{group.title} over time", description, 4.3, paint)


def _trace(panel: Axes, series: Series, values: Floats, color: str) -> None:
    if not np.isfinite(values).any():
        panel.text(0.5, 0.5, "no data", transform=panel.transAxes, ha="center", color=MUTED)
        return
    if series.count <= _DENSE:
        finite = np.where(np.isfinite(values), values, np.nan)
        panel.plot(*interrupted(series.time, finite, series.broken), color=color)
        return
    band = envelope(series.time, values, 0.0, max(series.duration, series.period))
    panel.fill_between(band.time, band.low, band.high, color=color, alpha=0.35, linewidth=0.4)
    panel.plot(band.time, band.mean, color=color, linewidth=0.8)


def _marks(panel: Axes, series: Series, index: int) -> None:
    width = max(series.duration, series.period)
    in_panel = panel.get_xaxis_transform()
    saturated = stretches(series.time[series.saturated[:, index]], width)
    if len(saturated):
        line = np.insert(saturated.ravel(), np.arange(2, saturated.size, 2), np.nan)
        panel.plot(
            line, np.full(len(line), 0.985), color=BAD, linewidth=3, solid_capstyle="butt", transform=in_panel
        )
    lost = stretches(series.time[1:][series.missing > 0], width).mean(axis=1)
    if len(lost):
        nowhere = np.full(len(lost), np.nan)
        ticks = np.column_stack([lost, lost, nowhere]).ravel()
        heights = np.tile([0.0, 0.07, np.nan], len(lost))
        panel.plot(ticks, heights, color=INK, linewidth=0.7, transform=in_panel)


def noise_bars(noise: Noise, name: str) -> str | None:
    """One bar for each channel: its noise relative to the limit. None if no limit is known."""
    ratio = noise.deviation / noise.limit * 100
    known = [index for index in range(len(CHANNELS)) if np.isfinite(ratio[index])]
    if not known:
        return None

    def paint(figure: Figure) -> None:
        margins(figure, left=0.13)
        panel = figure.subplots()
        rows = np.arange(len(known))
        shown = np.array([ratio[index] for index in known])
        most = max(125.0, min(float(shown.max()) * 1.25, 400.0))
        for row, index in enumerate(known):
            above = ratio[index] > 100
            panel.barh(row, min(shown[row], most), 0.62, color=BAD if above else PLAIN)
            text = f"{number(float(ratio[index]), 2)} %{' above the limit' if above else ''}"
            inside = shown[row] > 0.8 * most
            panel.text(
                min(shown[row], most) - 0.01 * most if inside else shown[row] + 0.01 * most, row, text,
                va="center", ha="right" if inside else "left", color=INK,
            )  # fmt: skip
        panel.axvline(100, color=LIMIT, linestyle="--", linewidth=1.2)
        panel.text(100.8, -0.75, "limit of a healthy sensor", color=LIMIT, va="center")
        panel.set_yticks(rows, [CHANNELS[index].title for index in known])
        panel.set_ylim(len(known) - 0.4, -1.2)
        panel.set_xlim(0, most)
        panel.set_xlabel("noise (standard deviation), % of the limit of a healthy sensor")
        panel.grid(axis="y", visible=False)

    texts = [f"{CHANNELS[index].title} {number(float(ratio[index]), 2)} %" for index in known]
    return draw(
        name, "Noise of each axis against the limit", ", ".join(texts) + ".", 0.9 + 0.24 * len(known), paint
    )


def cutoffs(series: Series) -> dict[str, float]:
    """The cut-off frequency of each group's filter, Hz, where it is known."""
    filters = meaning(series.subject.settings, round(series.subject.rate_hz))
    found = {}
    if filters.cutoff_hz is not None:
        found["force"] = found["torque"] = float(filters.cutoff_hz)
    if filters.acceleration is not None:
        found["acceleration"] = float(filters.acceleration.bandwidth_hz)
    if filters.angular_rate is not None:
        found["angular_rate"] = float(filters.angular_rate.bandwidth_hz)
    return found


def spectra(series: Series, spectrum: Spectrum, name: str) -> str:
    """Four panels, one for each group; the three axes in it and the cut-off frequency of its filter."""
    cuts = cutoffs(series)
    highest = float(spectrum.frequency[-1])

    def paint(figure: Figure) -> None:
        margins(figure, top_in=0.25, wspace=0.17)
        panels = figure.subplots(2, 2, sharex=True).ravel()
        for index, (group, panel) in enumerate(zip(GROUPS, panels, strict=True)):
            for axis in range(3):
                density = spectrum.density[:, 3 * index + axis]
                if np.isfinite(density).any():
                    panel.loglog(
                        spectrum.frequency, density, DASHES[axis],
                        color=AXES[axis], linewidth=0.8, label="xyz"[axis],
                    )  # fmt: skip
            plain_log(panel)
            panel.set_title(f"{group.title}, {group.unit}/√Hz")
            panel.set_xlim(float(spectrum.frequency[0]), highest)
            _cutoff(panel, cuts.get(group.name), highest)
            if np.isfinite(spectrum.density[:, 3 * index : 3 * index + 3]).any():
                panel.legend(loc="lower left", ncols=3, handlelength=2.2, columnspacing=1.2)
            if index >= 2:
                panel.set_xlabel("frequency, Hz")

    marked = [
        f"{group.title}: {cuts[group.name]:g} Hz"
        for group in GROUPS
        if cuts.get(group.name, np.inf) < highest
    ]
    description = (
        f"Amplitude spectral density from {number(float(spectrum.frequency[0]))} to {number(highest)} Hz. "
        f"Cut-off marked at {', '.join(marked) if marked else 'no frequency'}."
    )
    return draw(name, "Spectra", description, 5.4, paint)


def _cutoff(panel: Axes, frequency: float | None, highest: float) -> None:
    if frequency is not None and frequency < highest:
        panel.axvline(frequency, color=LIMIT, linestyle="-.", linewidth=1.2)
        text = f"cut-off {frequency:g} Hz "
        panel.text(
            frequency, 0.97, text, color=LIMIT, ha="right", va="top", transform=panel.get_xaxis_transform()
        )


def drifts(drift: Drift, duration: float, name: str) -> str | None:
    """Force, torque and temperature as medians over time. None if the recording is too short."""
    if not drift.known:
        return None

    def paint(figure: Figure) -> None:
        axes = rows(figure, 3)
        for panel, first, label in ((axes[0], 0, "force, N"), (axes[1], 3, "torque, Nm")):
            for axis in range(3):
                panel.plot(
                    drift.time, drift.load[:, first + axis], DASHES[axis], color=AXES[axis], label="xyz"[axis]
                )
            panel.set_ylabel(f"Δ {label}")
            panel.legend(loc="upper left", ncols=3, handlelength=2.2, columnspacing=1.2)
        axes[2].plot(drift.time, drift.temperature, color=PLAIN)
        axes[2].set_ylabel("temperature, °C")
        axes[2].set_xlabel("time, s")
        axes[2].set_xlim(0, duration)

    change = drift.change
    description = (
        f"From the first tenth to the last: force {', '.join(number(float(v), 2) for v in change[:3])} "
        f"N, torque "
        f"{', '.join(number(float(v), 2) for v in change[3:])} Nm, temperature "
        f"{number(drift.temperature_change, 2)} °C."
    )
    return draw(name, "Drift and temperature", description, 4.3, paint)


_HISTOGRAM_BINS: Final = 121
_US: Final = 1e6


def intervals(timing: Timing, name: str) -> str | None:
    """Intervals over time, and how they are distributed. None if there are too few."""
    series = timing.series
    if len(timing.deviations) < 2:
        return None
    deviations = timing.deviations * _US
    reach = max(float(np.quantile(np.abs(deviations), 0.999)), 1.0) * 1.2
    inside = np.clip(deviations, -reach, reach)

    def paint(figure: Figure) -> None:
        margins(figure, hspace=0.4)
        upper, lower = figure.subplots(2, 1)
        band = envelope(series.time[1:], series.intervals * 1e3, 0.0, max(series.duration, series.period))
        upper.fill_between(band.time, band.low, band.high, color=PLAIN, alpha=0.5, linewidth=0.4)
        upper.plot(band.time, band.high, ".", color=PLAIN, markersize=1.5)
        upper.set_xlim(0, max(series.duration, series.period))
        upper.set_ylabel("interval, ms")
        upper.set_xlabel("time, s")
        lower.hist(inside, bins=np.linspace(-reach, reach, _HISTOGRAM_BINS).tolist(), color=PLAIN, log=True)
        lower.axvline(0, color=LIMIT, linestyle="--", linewidth=1)
        lower.set_xlim(-reach, reach)
        lower.set_xlabel(f"interval minus the typical one of {number(series.period * 1e3, 5)} ms, µs")
        lower.set_ylabel("samples")
        lower.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        lower.yaxis.set_minor_formatter(NullFormatter())

    beyond = int(np.sum(np.abs(deviations) > reach))
    description = (
        f"{count(len(deviations), 'interval')} without a loss; the standard deviation is "
        f"{number(float(deviations.std()))} "
        f"µs, the greatest deviation {number(float(np.abs(deviations).max()))} µs; {beyond} beyond the "
        f"ends are counted "
        "in the outermost bars."
    )
    return draw(name, "Intervals between samples", description, 4.0, paint)


class _Row(NamedTuple):
    title: str
    time: Floats
    """s"""
    color: str


def events(timing: Timing, name: str) -> str | None:
    """When what happened: a row for each warning, saturated channel and kind of frame. None if nothing."""
    series = timing.series
    rows = _rows(timing)
    if not rows:
        return None
    width = max(series.duration, series.period)

    def paint(figure: Figure) -> None:
        margins(figure, left=0.03 + 0.0075 * max(len(row.title) for row in rows))
        panel = figure.subplots()
        for index, row in enumerate(rows):
            bars = stretches(row.time, width)
            line = np.insert(bars.ravel(), np.arange(2, bars.size, 2), np.nan)
            panel.plot(line, np.full(len(line), index), color=row.color, linewidth=11, solid_capstyle="butt")
        panel.set_yticks(range(len(rows)), [row.title for row in rows])
        panel.set_ylim(len(rows) - 0.4, -0.6)
        panel.set_xlim(0, width)
        panel.set_xlabel("time, s")
        panel.grid(axis="y", visible=False)
        panel.axhline(len(rows) - 0.4, color=MUTED, linewidth=0.6)

    described = ", ".join(f"{row.title}: {count(len(row.time), 'time')}" for row in rows)
    return draw(name, "What happened when", f"{described}.", 0.8 + 0.28 * len(rows), paint)


def _rows(timing: Timing) -> list[_Row]:
    series, frames = timing.series, timing.series.frames

    def of_frames(mask: Bools) -> Floats:
        return series.frame_time[mask]

    invalid = frames.flags & DataFlag.INVALID != 0
    rows = [
        *(_Row(f"Warning: {meaning.meaning}", series.time[series.samples.warnings & meaning.flag != 0], BAD)
          for meaning, *_ in checks.raised(series)),
        *(_Row(f"Saturated: {channel.title}", series.time[series.saturated[:, index]], X)
          for index, channel in enumerate(CHANNELS)),
        _Row("Samples lost", series.time[1:][series.missing > 0], INK),
        _Row("Repeated frames", of_frames((frames.flags & DataFlag.REPEATED != 0) & ~invalid), Z),
        _Row("Invalid frames", of_frames(invalid), BAD),
    ]  # fmt: skip
    return [row for row in rows if len(row.time)]
