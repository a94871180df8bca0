"""The sections of one sensor's report, in the order of the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from clients.report import plots, stream_plots
from clients.report.channels import CHANNELS, GROUPS, limit_origin
from clients.report.envelope import BINS
from clients.report.examine import Examination
from clients.report.text import Markup, element, text
from clients.report.words import count, figure, moment, seconds, share
from protocol.meaning import meaning, value_meaning
from protocol.settings import SETTINGS


def sections(examination: Examination, name: str) -> list[Markup]:
    """Of one sensor; `name` is the prefix of the ids of its plots."""
    return [
        _identity(examination),
        _settings(examination),
        _over_time(examination, name),
        _noise(examination, name),
        _spectrum(examination, name),
        _drift(examination, name),
        _stamps(examination, name),
        _events(examination, name),
    ]


def _section(title: str, *parts: Markup) -> Markup:
    return element("section", Markup("\n").join([element("h2", text(title)), *parts]))


def _figure(svg: str | None, caption: str) -> Markup:
    if svg is None:
        return Markup("")
    # Matplotlib escaped what is in the SVG; nothing in it comes from a device.
    return element("figure", Markup(svg) + element("figcaption", text(caption)))


def _facts(rows: Iterable[tuple[str, str]]) -> Markup:
    body = Markup("\n").join(
        Markup('<tr><th scope="row">') + text(key) + Markup("</th><td>") + text(value) + Markup("</td></tr>")
        for key, value in rows
    )
    return Markup(f'<div class="wide"><table class="facts"><tbody>{body}</tbody></table></div>')


def _table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], numbers: range = range(0)
) -> Markup:
    """The first column heads the rows; the columns in `numbers` are right-aligned."""

    def cells(row: Sequence[str]) -> Markup:
        made = [Markup('<th scope="row">') + text(row[0]) + Markup("</th>")]
        for place, value in enumerate(row[1:], 1):
            made.append(
                Markup('<td class="number">' if place in numbers else "<td>") + text(value) + Markup("</td>")
            )
        return Markup("<tr>") + Markup("").join(made) + Markup("</tr>")

    heads = Markup("").join(
        Markup(f'<th scope="col"{" class=number" if place in numbers else ""}>')
        + text(word)
        + Markup("</th>")
        for place, word in enumerate(head)
    )
    body = Markup("\n").join(cells(row) for row in rows)
    return (
        Markup('<div class="wide"><table>') + element("caption", text(caption))
        + Markup(f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>")
    )  # fmt: skip


def _paragraphs(*sentences: str) -> Markup:
    return Markup("\n").join(element("p", text(sentence)) for sentence in sentences if sentence)


def _identity(examination: Examination) -> Markup:
    subject, series = examination.subject, examination.series
    stamps = subject.columns.stamp_ns
    when = f"{moment(int(stamps[0]))} to {moment(int(stamps[-1]))}" if len(stamps) else "nothing was received"
    rows = [
        ("Name", subject.name), ("Serial number", subject.serial), ("Hardware", subject.hardware),
        ("Firmware", subject.firmware), ("Place on the bus", str(subject.place)), ("Source", subject.source),
        ("Recorded", when), ("Length", seconds(series.duration)),
        ("Frames", f"{count(len(subject.columns), 'frame')}, of which {count(series.count, 'sample')}"),
    ]  # fmt: skip
    return _section("Sensor and recording", _facts(rows), _paragraphs(*subject.remarks))


def _settings(examination: Examination) -> Markup:
    settings = examination.subject.settings
    if not settings:
        return _section("Settings", _paragraphs("The settings are not known."))
    rows = [
        (name, str(settings[name]).lower(), value_meaning(name, settings[name]))
        for name in SETTINGS
        if name in settings
    ]
    together = "; ".join(meaning(settings).lines())
    return _section(
        "Settings", _table("Settings in force, and what each means", ("Setting", "Value", "Meaning"), rows),
        _paragraphs(f"Together: {together}."),
    )  # fmt: skip


def _over_time(examination: Examination, name: str) -> Markup:
    series = examination.series
    parts = []
    for group in GROUPS:
        if group.is_imu and series.imu_off:
            continue
        marks = "Line: mean; band: least to greatest value." if series.count > 2 * BINS else ""
        if series.missing.any():
            marks += " Ticks at the bottom: samples lost there."
        first = 3 * GROUPS.index(group)
        if series.saturated[:, first : first + 3].any():
            marks += " Thick line at the top: saturated."
        parts += [element("h3", text(group.title)),
                  _figure(plots.over_time(series, group, f"{name}-{group.name}"), marks.strip())]  # fmt: skip
    if series.imu_off:
        parts.append(_paragraphs("The IMU is off."))
    return _section("Force, torque and IMU over time", *parts)


def _noise(examination: Examination, name: str) -> Markup:
    noise, subject = examination.noise, examination.subject
    rows = []
    for place, channel in enumerate(CHANNELS):
        if channel.group.is_imu and examination.series.imu_off:
            continue
        deviation, limit = float(noise.deviation[place]), float(noise.limit[place])
        rows.append((
            channel.title,
            f"{figure(deviation)} {channel.group.unit}" if np.isfinite(deviation) else "not known",
            f"{figure(limit)} {channel.group.unit}" if np.isfinite(limit) else "not known",
            share(deviation, limit) if np.isfinite(deviation / limit) else "not known",
            _verdict(deviation, limit),
        ))  # fmt: skip
    basis = f"From {noise.calm} calm windows of {figure(noise.window_s, 2)} s out of {noise.windows}."
    origin = limit_origin(subject.sinc_length) if subject.sinc_length is not None else ""
    fir = "FIR is on: a healthy sensor is quieter than these limits." if subject.settings.get("fir") else ""
    return _section(
        "Noise", _paragraphs(basis, origin, fir),
        _figure(plots.noise_bars(noise, f"{name}-noise"), "A bar that passes the dashed line is too noisy."),
        _table(
            "Noise: standard deviation", ("Axis", "Noise", "Limit", "Of the limit", "Outcome"), rows,
            range(1, 4),
        ),
    )  # fmt: skip


def _verdict(deviation: float, limit: float) -> str:
    if not np.isfinite(deviation / limit):
        return "not judged"
    if deviation == 0:
        return "stands still"
    return "above the limit" if deviation > limit else "within the limit"


def _spectrum(examination: Examination, name: str) -> Markup:
    spectrum, series = examination.spectrum, examination.series
    if spectrum is None:
        return _section("Spectrum", _paragraphs("No stretch without an interruption is long enough."))
    cuts, highest = plots.cutoffs(series), float(spectrum.frequency[-1])
    notes = []
    for group in GROUPS:
        if group.is_imu and series.imu_off:
            continue
        cut = cuts.get(group.name)
        if cut is None:
            notes.append(f"{group.title}: the cut-off of this filter is not in the note's tables.")
        elif cut >= highest:
            notes.append(
                f"{group.title}: the filter's cut-off, {figure(cut)} Hz, is above half the sampling "
                f"rate, so what is "
                "between the two folds down into the spectrum."
            )
    filled = f" {count(spectrum.filled, 'missing sample')} in it were filled in." if spectrum.filled else ""
    caption = (
        f"From {seconds(spectrum.span_s)}, {count(spectrum.segments, 'segment')} averaged, resolution "
        f"{figure(spectrum.resolution_hz, 2)} Hz.{filled} Solid: x, dashed: y, dotted: z. Dash-dotted: "
        f"cut-off frequency."
    )
    return _section(
        "Spectrum", _figure(plots.spectra(series, spectrum, f"{name}-spectrum"), caption), _paragraphs(*notes)
    )


def _drift(examination: Examination, name: str) -> Markup:
    drift = examination.drift
    caption = "Medians of about a second, less the first. Solid: x, dashed: y, dotted: z."
    facts = []
    if drift.known:
        change = drift.change
        facts = [
            ("Force x, y, z", ", ".join(f"{value:+.3f}" for value in change[:3]) + " N"),
            ("Torque x, y, z", ", ".join(f"{value:+.4f}" for value in change[3:]) + " Nm"),
            ("Temperature", f"{drift.temperature_change:+.2f} °C"),
        ]
    table = _table("Change from the first tenth to the last", ("", "Change"), facts) if facts else Markup("")
    return _section(
        "Drift and temperature",
        _paragraphs(drift.sentence()),
        _figure(plots.drifts(drift, examination.series.duration, f"{name}-drift"), caption),
        table,
    )


def _stamps(examination: Examination, name: str) -> Markup:
    timing, series = examination.timing, examination.series
    deviations = np.abs(timing.deviations) * 1e6

    def quantile(part: float) -> str:
        return f"{figure(float(np.quantile(deviations, part)))} µs" if len(deviations) else "not known"

    rows = [
        ("Usual interval", f"{figure(series.period * 1e3, 6)} ms ({figure(series.rate, 6)} Hz)"),
        ("Deviation from it: median, 95 %, 99.9 %, greatest",
         ", ".join(quantile(part) for part in (0.5, 0.95, 0.999, 1.0))),
        ("Samples lost", f"{timing.lost} ({share(timing.lost, timing.lost + series.count)})"),
        ("Of these, had by the server but not taken in time", str(timing.withheld)),
        ("Frames marked GAP", str(timing.gaps)),
        ("Frames repeated", str(timing.repeated)), ("Frames invalid", str(timing.invalid)),
        ("Wall clock set", f"{len(timing.clock_steps)} times"),
    ]  # fmt: skip
    if series.step > 1:
        rows.append(("Recorded", f"one sample in {series.step}"))
    return _section(
        "Stamps", _figure(stream_plots.intervals(timing, f"{name}-stamps"), "Above: every interval, "
        "least to greatest of each "
        "bin. Below: how often each occurs (logarithmic), without losses."), _facts(rows),
    )  # fmt: skip


def _events(examination: Examination, name: str) -> Markup:
    plot = stream_plots.events(examination.timing, f"{name}-events")
    if plot is None:
        return _section(
            "Warnings and saturation",
            _paragraphs(
                "No warning, no saturation, no lost, repeated or invalid frame in the whole recording."
            ),
        )
    return _section("Warnings and saturation", _figure(plot, "A bar is where it happened at least once."))
