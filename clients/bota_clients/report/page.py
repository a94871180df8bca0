"""Fills the page: `report.html` is its template, `style.css` its style sheet. Also the same as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import jinja2
import numpy as np

from bota_clients import numbers
from bota_clients.numbers import figure, moment, share
from bota_clients.report import plots
from bota_clients.report.checks import Examination
from bota_clients.report.plots import BINS
from bota_clients.report.series import CHANNELS, GROUPS, limit_origin
from bota_ethercat.health.verdict import Level
from bota_ethercat.sensor.meaning import meaning, value_meaning
from bota_ethercat.settings import SETTINGS
from bota_ethercat.text.untrusted import printable, visible


def _plain(value: Any) -> Any:
    """Control and bidirectional characters of a text as `?`; escaping comes after this."""
    return value if value is None or hasattr(value, "__html__") else visible(str(value))


_PAGE: Final = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    finalize=_plain,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_PAGE.filters |= {name: getattr(numbers, name) for name in ("count", "figure", "seconds")}


def render(examinations: Sequence[Examination], *, made: str, program: str, note: str = "") -> str:
    """The whole page. `made` is the time, `program` what made it; `note` is a remark of the user's."""
    views = [_view(examination, f"s{number}") for number, examination in enumerate(examinations)]
    first = examinations[0].subject
    several = f"{len(views)} sensors" if len(views) > 1 else first.who
    return _PAGE.get_template("report.html").render(
        title=f"Sensor report: {several}",
        made=made,
        program=program,
        note=printable(note, 2000),
        sensors=views,
        not_possible=Level.NOT_POSSIBLE,
    )


def _view(examination: Examination, name: str) -> dict[str, Any]:
    """What the template shows of one sensor; `name` is the prefix of the ids of its plots."""
    subject, series, drift = examination.subject, examination.series, examination.drift
    stamps, spectrum = subject.columns.stamp_ns, examination.spectrum
    groups = [group for group in GROUPS if not (group.is_imu and series.imu_off)]
    chop = subject.settings.get("chop")
    cutoffs = plots.cutoffs(series)
    return {
        **vars(examination),
        "name": f"Sensor {subject.position}: {subject.who}",
        "checks": sorted(examination.checks, key=lambda check: -check.level),
        "recorded": f"{moment(int(stamps[0]))} to {moment(int(stamps[-1]))}"
        if len(stamps)
        else "nothing was received",
        "settings": [
            (setting, str(value).lower(), value_meaning(setting, value, round(subject.rate_hz), chop))
            for setting in SETTINGS
            if (value := subject.settings.get(setting)) is not None
        ],
        "meaning": "; ".join(meaning(subject.settings, round(subject.rate_hz)).lines()),
        "over_time": [
            (group.title, plots.over_time(series, group, f"{name}-{group.name}"), _marks(examination, at))
            for at, group in enumerate(GROUPS)
            if group in groups
        ],
        "limit_origin": limit_origin(subject.sinc_length) if subject.sinc_length is not None else "",
        "noise_rows": _noise_rows(examination),
        "cutoffs": [(group.title, cutoffs.get(group.name)) for group in groups],
        "drift_rows": _drift_rows(examination),
        "stamp_rows": _stamp_rows(examination),
        "plots": {
            "noise": plots.noise_bars(examination.noise, f"{name}-noise"),
            "spectrum": plots.spectra(series, spectrum, f"{name}-spectrum") if spectrum else None,
            "drift": plots.drifts(drift, series.duration, f"{name}-drift"),
            "stamps": plots.intervals(examination.timing, f"{name}-stamps"),
            "events": plots.events(examination.timing, f"{name}-events"),
        },
    }


def _marks(examination: Examination, group: int) -> str:
    """What the marks in the plot of a group over time mean."""
    series = examination.series
    marks = ["Line: mean; band: minimum to maximum."] if series.count > 2 * BINS else []
    if series.missing.any():
        marks.append("Ticks at the bottom: samples lost.")
    if series.saturated[:, 3 * group : 3 * group + 3].any():
        marks.append("Thick line at the top: saturated.")
    return " ".join(marks)


def _noise_rows(examination: Examination) -> list[tuple[str, ...]]:
    noise, rows = examination.noise, []
    for channel, deviation, limit in zip(CHANNELS, noise.deviation, noise.limit, strict=True):
        if channel.group.is_imu and examination.series.imu_off:
            continue
        ratio = deviation / limit
        known = bool(np.isfinite(ratio))
        outcome = f"{'above' if ratio > 1 else 'within'} the limit" if known else "not judged"
        rows.append((
            channel.title,
            *(f"{figure(float(value))} {channel.group.unit}" if np.isfinite(value) else "not known"
              for value in (deviation, limit)),
            share(float(deviation), float(limit)) if known else "not known",
            "constant" if ratio == 0 else outcome,
        ))  # fmt: skip
    return rows


def _drift_rows(examination: Examination) -> list[tuple[str, str]]:
    drift = examination.drift
    if not drift.known:
        return []
    return [
        ("Force x, y, z", ", ".join(f"{value:+.3f}" for value in drift.change[:3]) + " N"),
        ("Torque x, y, z", ", ".join(f"{value:+.4f}" for value in drift.change[3:]) + " Nm"),
        ("Temperature", f"{drift.temperature_change:+.2f} °C"),
    ]


def _stamp_rows(examination: Examination) -> list[tuple[str, object]]:
    timing, series = examination.timing, examination.series
    off = np.abs(timing.deviations) * 1e6
    quantiles = np.quantile(off, (0.5, 0.95, 0.999, 1)) if len(off) else ()
    rows: list[tuple[str, object]] = [
        ("Typical interval", f"{figure(series.period * 1e3, 6)} ms ({figure(series.rate, 6)} Hz)"),
        (
            "Deviation from it: median, 95 %, 99.9 %, maximum",
            ", ".join(f"{figure(float(value))} µs" for value in quantiles) or "not known",
        ),
        ("Samples lost", f"{timing.lost} ({share(timing.lost, timing.lost + series.count)})"),
        ("Of these, available at the server but not read in time", timing.withheld),
        ("Frames marked GAP", timing.counts.gaps),
        ("Frames repeated", timing.counts.repeated),
        ("Frames invalid", timing.counts.invalid),
        ("Clock adjusted", f"{len(timing.clock_steps)} times"),
    ]
    return [*rows, ("Recorded", f"one sample in {series.step}")] if series.step > 1 else rows


def as_json(examinations: Sequence[Examination]) -> str:
    """The verdicts and checks for programs."""
    return json.dumps(
        [
            {
                "sensor": each.subject.position, "name": each.subject.name, "serial": each.subject.serial,
                "source": each.subject.source, "verdict": each.verdict.level.key,
                "sentence": each.verdict.sentence, "remarks": list(each.subject.remarks),
                "stream": {"verdict": each.stream.level.key, "sentence": each.stream.sentence},
                "checks": [
                    {"check": c.name, "outcome": c.level.key, "found": c.found, "matters": c.matters,
                    "remedy": c.remedy}
                    for c in each.checks
                ],
            }
            for each in examinations
        ],
        indent=1, ensure_ascii=False,
    )  # fmt: skip
