"""The page: one HTML file with nothing outside it. Everything that is not a tag of ours is escaped here."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Sequence
from typing import Final

from clients.report.check import Check, Level, Verdict
from clients.report.examine import Examination
from clients.report.sections import sections
from clients.report.style import CSS
from clients.report.text import Markup, element, text
from protocol.text import printable

_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
"""Whatever a device calls itself, the page runs and loads nothing."""

METHOD: Final = (
    "Samples are the frames that are neither repeated nor invalid. Times are those of the server's "
    "monotonic clock.",
    "Over time: where there are more samples than the plot is wide, the line is the mean and the band "
    "reaches from the "
    "least to the greatest value of each bin, so no spike is lost.",
    "Noise: the samples are cut into windows of half a second (at least 32 samples). In each a cubic is "
    "fitted and taken "
    "off, which removes slow motion and drift; the standard deviation is that of the rest. The calmer "
    "half of the windows "
    "is kept, by the range of the cubics of force and torque, which leaves contacts and quick motion "
    "out; the noise is the "
    "median over them. If two axes of the accelerometer are above their limit even then, the sensor was "
    "shaken, and no "
    "judgement is made.",
    "Limits: Bota's own test limits for a healthy sensor. They are for the sensor without the FIR "
    "filter; with it on a healthy "
    "sensor is quieter, and the check is lenient. For the IMU one figure, 0.1, is published without a "
    "unit or a filter; it is "
    "taken as m/s² and rad/s. Beside it, an axis with more than four times the noise of the other two "
    "is pointed out.",
    "Spectra: Welch's method (Hann window, half overlapping, linear trend taken off) on the longest "
    "stretch without an "
    "interruption; up to three missing samples in a row are filled in by a straight line. What the "
    "sensor did in that time is "
    "in the spectra too. Cut-off frequencies are those of the design note's tables, which promise nothing.",
    "Lost samples are told by the time that passed between two samples and by the mark GAP. A stuck "
    "value is one that force or "
    "torque keep for more than 0.1 s, or the IMU for 5 s.",
)


def render(examinations: Sequence[Examination], *, made: str, program: str, note: str = "") -> str:
    """The whole page. `made` is when, `program` what made it; `note` is the user's own remark."""
    first = examinations[0].subject
    title = f"{first.name}, serial {first.serial}"
    if len(examinations) > 1:
        title = f"{len(examinations)} sensors"
    title = f"Sensor report: {title}"
    body = [element("h1", text(title)), element("p", text(f"Made {made} by {program}"), cls="sub")]
    if note:
        body.append(element("p", text(f"Note: {printable(note, 2000)}")))
    if len(examinations) > 1:
        body.append(_overview(examinations))
    body.extend(
        _article(examination, place, len(examinations) > 1) for place, examination in enumerate(examinations)
    )
    method = Markup("").join(element("p", text(paragraph)) for paragraph in METHOD)
    body.append(element("section", Markup('<h2 id="method">How it was worked out</h2>') + method))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{html.escape(_POLICY)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body) + "\n</main>\n</body>\n</html>\n"
    )  # fmt: skip


def _overview(examinations: Sequence[Examination]) -> Markup:
    items = Markup("").join(
        Markup(f'<li><a href="#sensor-{place}">') + text(_name(each)) + Markup("</a>: ")
        + text(each.verdict.headline) + Markup("</li>")
        for place, each in enumerate(examinations)
    )  # fmt: skip
    return Markup(f'<nav aria-label="Sensors"><ul>{items}</ul></nav>')


def _name(examination: Examination) -> str:
    subject = examination.subject
    return f"Sensor {subject.place}: {subject.name}, serial {subject.serial}"


def _article(examination: Examination, place: int, several: bool) -> Markup:
    heading = element("h2", text(_name(examination)), id=f"sensor-{place}") if several else Markup("")
    parts = [
        heading,
        _banner(examination.verdict),
        _checks(examination.checks),
        *sections(examination, f"s{place}"),
    ]
    return element("article", Markup("\n").join(parts))


def _class(level: Level) -> str:
    return level.name.lower().replace("_", "-")


def _banner(verdict: Verdict) -> Markup:
    inside = element("strong", text(f"{verdict.level.symbol} {verdict.headline}")) + element(
        "p", text(verdict.sentence)
    )
    return element("section", inside, cls=f"verdict {_class(verdict.level)}", aria_label="Verdict")


def _level(check: Check) -> Markup:
    return Markup(f'<span class="level {_class(check.level)}"><b aria-hidden="true">{check.level.symbol}</b> '
                  f"{check.level.word}</span>")  # fmt: skip


def _checks(checks: Iterable[Check]) -> Markup:
    worst_first = sorted(checks, key=lambda check: -check.level)
    wrong = [check for check in worst_first if check.level >= Level.NOT_POSSIBLE]
    parts = []
    for check in wrong:
        sentences = Markup("").join(
            element("p", Markup(f"<b>{label}</b> ") + text(words))
            for label, words in (
                ("Found:", check.found),
                ("It matters because:", check.matters),
                ("Do:", check.remedy),
            )
            if words
        )
        heading = element("h3", _level(check) + text(f" {check.name}"))
        parts.append(element("section", heading + sentences, cls="keep"))
    rows = Markup("\n").join(
        Markup('<tr><th scope="row">') + text(check.name) + Markup("</th><td>") + _level(check) + Markup(
        "</td><td>")
        + text(check.found) + Markup("</td></tr>")
        for check in worst_first
    )  # fmt: skip
    table = Markup(
        '<div class="wide"><table><caption>Every check</caption><thead><tr><th scope="col">Check</th>'
        f'<th scope="col">Outcome</th><th '
        f'scope="col">Found</th></tr></thead><tbody>{rows}</tbody></table></div>'
    )
    return element("section", Markup("<h2>Findings</h2>") + Markup("\n").join(parts) + table)


def as_json(examinations: Sequence[Examination]) -> str:
    """The verdicts and checks for programs."""
    return json.dumps(
        [
            {
                "sensor": each.subject.place, "name": each.subject.name, "serial": each.subject.serial,
                "source": each.subject.source, "verdict": _class(each.verdict.level),
                "sentence": each.verdict.sentence,
                "checks": [
                    {"check": c.name, "outcome": _class(c.level), "found": c.found, "matters": c.matters,
                    "remedy": c.remedy}
                    for c in each.checks
                ],
            }
            for each in examinations
        ],
        indent=1, ensure_ascii=False,
    )  # fmt: skip
