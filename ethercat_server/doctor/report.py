"""Output of the doctor: text, or one JSON object."""

from __future__ import annotations

import json
import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, TextIO

from bota_ethercat.health.verdict import Level
from bota_ethercat.text.untrusted import visible
from ethercat_server.doctor.finding import NAMES, Finding

_COLORS: Final = {
    Level.GOOD: "\x1b[32m", Level.NOT_POSSIBLE: "\x1b[2m", Level.NOTE: "\x1b[36m", Level.LOOK: "\x1b[33m",
    Level.TROUBLE: "\x1b[1;31m",
}  # fmt: skip
_END: Final = "\x1b[0m"
_CLEAR_LINE: Final = "\x1b[K"
_BOLD: Final = "\x1b[1m"
_LEVEL_WIDTH: Final = max(map(len, NAMES.values()))
_NAME_WIDTH: Final = 20
_INDENT: Final = " " * (2 + _LEVEL_WIDTH + 2 + _NAME_WIDTH + 2)
_USUAL_WIDTH: Final = 120
_LEAST_TEXT: Final = 30
EXIT_CODES: Final = {Level.GOOD: 0, Level.NOT_POSSIBLE: 0, Level.NOTE: 0, Level.LOOK: 0, Level.TROUBLE: 1}
_MOST_REPEATED: Final = 8
"""Findings that the end repeats: with the verdict they fit 80 x 24."""


def worst(findings: Iterable[Finding]) -> Level:
    """The worst level, skipped checks aside."""
    return max((f.level for f in findings if f.level is not Level.NOT_POSSIBLE), default=Level.GOOD)


def verdict(findings: Iterable[Finding]) -> Level:
    """What all findings come to; notes are nothing to look at."""
    found = worst(findings)
    return found if found in {Level.LOOK, Level.TROUBLE} else Level.GOOD


def wants_color(stream: TextIO, environment: Mapping[str, str]) -> bool:
    """Only a terminal, and not if the user set NO_COLOR (no-color.org)."""
    return stream.isatty() and not environment.get("NO_COLOR") and environment.get("TERM") != "dumb"


class Report:
    """Writes findings as text, as they come."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout
        self._color = wants_color(self._stream, os.environ)
        width = (
            shutil.get_terminal_size((_USUAL_WIDTH, 24)).columns if self._stream.isatty() else _USUAL_WIDTH
        )
        self._width = max(_LEAST_TEXT, width - len(_INDENT))
        self._subject = ""
        self._waiting = False

    def heading(self, text: str) -> None:
        """The first line."""
        self._say(text + "\n")

    def wait(self, text: str) -> None:
        """Show progress on a terminal, until the next line."""
        if self._stream.isatty():
            self._stream.write(f"{text}\r")
            self._stream.flush()
            self._waiting = True

    def write(self, finding: Finding) -> None:
        """One finding, under its subject."""
        if finding.subject != self._subject:
            self._say(("\n" if self._subject else "") + self._painted(finding.subject, _BOLD))
            self._subject = finding.subject
        level = NAMES[finding.level].ljust(_LEVEL_WIDTH)
        first, *rest = self._lines(finding.found)
        head = self._painted(level, _COLORS[finding.level])
        self._say(f"  {head}  {finding.check.ljust(_NAME_WIDTH)}  {first}")
        for line in (*rest, *self._lines(finding.why)) if finding.why else rest:
            self._say(_INDENT + line)
        for command in finding.commands:
            self._say(f"{_INDENT}$ {command}")

    def summary(self, findings: Sequence[Finding]) -> None:
        """The verdict, with what matters once more, for the rest may have scrolled away."""
        counts = {level: sum(f.level is level for f in findings) for level in reversed(NAMES)}
        text = ", ".join(f"{count} {_counted(level, count)}" for level, count in counts.items() if count)
        level = worst(findings)
        self._say(f"\n{self._painted(verdict(findings).words.capitalize(), _COLORS[level])}: {text}")
        matters = [f for f in findings if f.level >= Level.LOOK]
        matters.sort(key=lambda finding: -finding.level)
        width = self._width + len(_INDENT)
        for finding in matters[:_MOST_REPEATED]:
            name = NAMES[finding.level].ljust(_LEVEL_WIDTH)
            text = f"  {name}  {finding.subject}, {finding.check}: {finding.found}"
            lines = textwrap.wrap(
                text, width, subsequent_indent=" " * (4 + _LEVEL_WIDTH), max_lines=2, placeholder=" ..."
            )
            self._say("\n".join(lines))
        if len(matters) > _MOST_REPEATED:
            self._say(f"  and {len(matters) - _MOST_REPEATED} more above")

    def _lines(self, text: str) -> list[str]:
        return textwrap.wrap(text, self._width, break_on_hyphens=False, break_long_words=False) or [""]

    def _painted(self, text: str, color: str) -> str:
        return f"{color}{text}{_END}" if self._color else text

    def _say(self, text: str) -> None:
        if self._waiting:
            self._stream.write(_CLEAR_LINE)
            self._waiting = False
        self._stream.write(printable(text) + "\n")
        self._stream.flush()


def _counted(level: Level, count: int) -> str:
    name = NAMES[level]
    return f"{name}s" if level in {Level.NOTE, Level.LOOK} and count != 1 else name


def printable(text: str) -> str:
    """Without control characters from a device or a file; our own colors stay."""
    own = {*_COLORS.values(), _END, _BOLD}
    parts = text.split("\x1b")
    found = _lines(parts[0])
    for part in parts[1:]:
        color = next((c for c in own if ("\x1b" + part).startswith(c)), None)
        kept = part[len(color) - 1 :] if color else "?" + part
        found += (color or "") + _lines(kept)
    return found


def _lines(text: str) -> str:
    return "\n".join(map(visible, text.split("\n")))


def as_json(header: Mapping[str, Any], findings: Sequence[Finding]) -> str:
    """The whole report as one object."""
    found = {**header, "verdict": verdict(findings).key, "worst": NAMES[worst(findings)]}
    found |= {"findings": [f.as_json() for f in findings]}
    return json.dumps(found, indent=2, ensure_ascii=False, default=str)
