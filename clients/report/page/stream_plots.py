"""The plots of the stream: intervals between samples, and warnings and losses over time."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from clients.numbers import count
from clients.numbers import figure as number
from clients.report.checks import register
from clients.report.checks.channels import CHANNELS
from clients.report.checks.timing import Timing
from clients.report.page.drawing import BAD, INK, LIMIT, MUTED, PLAIN, X, Z, draw, margins
from clients.report.page.envelope import envelope, stretches
from clients.report.subjects.series import Bools, Floats
from protocol.framing import DataFlag

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
          for meaning, *_ in register.raised(series)),
        *(_Row(f"Saturated: {channel.title}", series.time[series.saturated[:, index]], X)
          for index, channel in enumerate(CHANNELS)),
        _Row("Samples lost", series.time[1:][series.missing > 0], INK),
        _Row("Repeated frames", of_frames((frames.flags & DataFlag.REPEATED != 0) & ~invalid), Z),
        _Row("Invalid frames", of_frames(invalid), BAD),
    ]  # fmt: skip
    return [row for row in rows if len(row.time)]
