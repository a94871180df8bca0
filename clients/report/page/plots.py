"""The plots of what was measured: force, torque and IMU over time, noise, spectra, drift."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from clients.numbers import figure as number
from clients.numbers import seconds
from clients.report.checks.channels import CHANNELS, GROUPS, Group
from clients.report.checks.noise import Noise
from clients.report.checks.spectrum import Spectrum
from clients.report.checks.surroundings import Drift
from clients.report.page import drawing
from clients.report.page.drawing import AXES, BAD, DASHES, INK, LIMIT, MUTED, PLAIN, draw, margins, plain_log
from clients.report.page.envelope import BINS, envelope, interrupted, stretches
from clients.report.subjects.series import Floats, Series
from protocol.sensor.meaning import meaning

_DENSE: Final = 2 * BINS
"""More samples than this are drawn as an envelope."""


def over_time(series: Series, group: Group, name: str) -> str:
    """Three panels, x, y and z: mean and range of each bin; marks where it was saturated or lost samples."""
    first = 3 * GROUPS.index(group)
    texts = []

    def paint(figure: Figure) -> None:
        axes = drawing.rows(figure, 3)
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
        axes = drawing.rows(figure, 3)
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
