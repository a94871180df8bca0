"""Fills the page: `report.html` is its template, `style.css` its style sheet. Also the same as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import jinja2
import numpy as np

from bota_clients import numbers
from bota_clients.numbers import figure, share
from bota_clients.report import plots
from bota_clients.report.checks import Examination
from bota_clients.report.series import CHANNELS, DENSE, GROUPS, limit_origin
from bota_ethercat.sensor.meaning import meaning, value_meaning
from bota_ethercat.settings import SETTINGS
from bota_ethercat.text.untrusted import printable, visible


def _plain(value: Any) -> Any:
    """Control and bidirectional characters of a text as `?`; escaping comes after this."""
    return value if value is None or hasattr(value, "__html__") else visible(str(value))


PAGE: Final = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    finalize=_plain,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
PAGE.filters |= {name: getattr(numbers, name) for name in ("count", "figure", "moment", "seconds", "share")}
PAGE.globals |= {"plots": plots, "DENSE": DENSE, "GROUPS": GROUPS, "limit_origin": limit_origin}


def render(examinations: Sequence[Examination], *, made: str, program: str, note: str = "") -> str:
    """The whole page. `made` is the time, `program` what made it; `note` is a remark of the user's."""
    first = examinations[0].subject
    several = f"{len(examinations)} sensors" if len(examinations) > 1 else first.who
    return PAGE.get_template("report.html").render(
        title=f"Sensor report: {several}",
        made=made,
        program=program,
        note=printable(note, 2000),
        sensors=[vars(examination) | _view(examination) for examination in examinations],
    )


def _view(examination: Examination) -> dict[str, Any]:
    """What the template shows of one sensor, beside the examination's own."""
    subject, series = examination.subject, examination.series
    rate_hz, chop = round(subject.info.rate_hz), subject.settings.get("chop")
    return {
        "name": f"Sensor {subject.info.sensor}: {subject.who}",
        "settings": [
            (setting, str(value).lower(), value_meaning(setting, value, rate_hz, chop))
            for setting in SETTINGS
            if (value := subject.settings.get(setting)) is not None
        ],
        "meaning": "; ".join(meaning(subject.settings, rate_hz).lines()),
        "noise_rows": _noise_rows(examination),
        "deviations": ", ".join(f"{figure(value * 1e6)} µs" for value in series.deviations) or "not known",
    }  # fmt: skip


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


def as_json(examinations: Sequence[Examination]) -> str:
    return json.dumps(
        [
            {
                "sensor": each.subject.info.sensor, "name": each.subject.info.name,
                "serial": each.subject.info.serial,
                "source": each.subject.source, "verdict": each.level.key,
                "sentence": each.sentence, "remarks": list(each.subject.remarks),
                "stream": {"verdict": each.stream.level.key, "sentence": each.stream.sentence},
                "checks": [
                    {"check": c.name, "outcome": c.level.key, "found": c.found, "matters": c.matters,
                    "remedy": c.remedy}
                    for c in each.checks
                ],
            }
            for each in examinations
        ],
        indent=1,
    )  # fmt: skip
