"""What a check finds, with its severity, effect and remedy; and their output as text or JSON."""

from __future__ import annotations

import functools
import json
import os
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, TextIO

from bota_ethercat.health.advice import CHECK_IT, IT_TELLS
from bota_ethercat.health.limits import Level
from bota_ethercat.text.untrusted import visible
from ethercat_server.errors import ServerError

# As the doctor calls the levels, and their colors on a terminal.
NAMES: Final = {
    Level.GOOD: "ok",
    Level.NOT_POSSIBLE: "skipped",
    Level.NOTE: "note",
    Level.LOOK: "warning",
    Level.TROUBLE: "bad",
}
_COLORS: Final = dict(zip(NAMES, ("\x1b[32m", "\x1b[2m", "\x1b[36m", "\x1b[33m", "\x1b[1;31m"), strict=True))


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One line of the report."""

    level: Level
    found: str
    why: str = ""  # its effect, and the remedy where no command is one
    commands: tuple[str, ...] = ()  # that fix it
    values: dict[str, Any] = field(default_factory=dict)  # details for the JSON output
    subject: str = ""
    check: str = ""

    def as_json(self) -> dict[str, Any]:
        names = ("subject", "check", "level", "found", "why", "commands", "values")
        return {name: getattr(self, name) for name in names} | {"level": NAMES[self.level]}


def finding(level: Level, found: str, why: str = "", /, *commands: str, **values: Any) -> CheckResult:
    """A finding of any level."""
    return CheckResult(level, found, why, commands, values)


ok = functools.partial(finding, Level.GOOD)  # nothing to fix
note = functools.partial(finding, Level.NOTE)  # little effect, or only under load
warning = functools.partial(finding, Level.LOOK)  # loses samples or increases their age
bad = functools.partial(finding, Level.TROUBLE)  # sensors cannot be read, or not reliably

# Whether it applies, and what is found then: the level's function above, the effect, commands.
Grade = tuple[object, Callable[..., CheckResult], str, *tuple[str, ...]]


def graded(found: str, *limits: Grade, why: str = "", **values: Any) -> CheckResult:
    """The finding by the first of the `limits` that applies; `ok`, and `why`, if none does."""
    for applies, make, effect, *commands in limits:
        if applies:
            return make(found, effect, *commands, **values)
    return ok(found, why, **values)


def skipped(why: str, *, subject: str = "", check: str = "") -> CheckResult:
    """Not checked."""
    return CheckResult(Level.NOT_POSSIBLE, f"not checked: {why}", subject=subject, check=check)


class CannotLookError(Exception):
    """A check is impossible here; the text says why."""


def examine(
    subject: str, check: str, look: Callable[..., CheckResult | Iterable[CheckResult]], *arguments: object
) -> Iterator[CheckResult]:
    """What `look(*arguments)` finds, with the check's name; an error in the check is a finding too."""
    try:
        found = look(*arguments)
        for each in (found,) if isinstance(found, CheckResult) else found:
            each = replace(each, found=_here(each.found), why=_here(each.why))  # noqa: PLW2901
            yield replace(each, subject=subject, check=check)
        return
    except CannotLookError as error:
        failed = skipped(str(error))
    except ServerError as error:
        failed = bad(_here(str(error)))
    except OSError as error:
        failed = skipped(error.strerror or str(error))
    except Exception as error:  # noqa: BLE001 - a check that fails must not stop the others
        failed = skipped(f"{type(error).__name__}: {error}; an error in ethercat-doctor, please report it")
    yield replace(failed, subject=subject, check=check)


def _here(text: str) -> str:
    """What others advise, as the doctor says it."""
    return text.replace(CHECK_IT, _SEE).replace(IT_TELLS, _SEE)


_SEE: Final = "see the checks of machine and bus"


def worst(findings: Iterable[CheckResult]) -> Level:
    """The worst level, skipped checks aside."""
    return max((f.level for f in findings if f.level is not Level.NOT_POSSIBLE), default=Level.GOOD)


def verdict(findings: Sequence[CheckResult]) -> Level:
    """What all findings come to; notes are nothing to look at, and without the bus nothing is good."""
    found = worst(findings)
    if found >= Level.LOOK:
        return found
    return next((f.level for f in findings if is_bus_unknown(f)), Level.GOOD)


def is_bus_unknown(finding: CheckResult) -> bool:
    """Whether it says that nobody could look at the bus."""
    return (finding.subject, finding.check, finding.level) == ("bus", "slaves", Level.NOT_POSSIBLE)


def as_json(header: Mapping[str, Any], findings: Sequence[CheckResult]) -> str:
    """The whole report as one object."""
    found = {**header, "verdict": verdict(findings).key, "worst": NAMES[worst(findings)]}
    found |= {"findings": [f.as_json() for f in findings]}
    return json.dumps(found, indent=2, default=str)


_LEVEL_WIDTH: Final = max(map(len, NAMES.values()))
_NAME_WIDTH: Final = 20
_INDENT: Final = " " * (2 + _LEVEL_WIDTH + 2 + _NAME_WIDTH + 2)
_USUAL_WIDTH: Final = 120
_LEAST_TEXT: Final = 30
_MOST_REPEATED: Final = 8  # findings that the end repeats: with the verdict they fit 80 x 24


def wants_color(stream: TextIO, environment: Mapping[str, str]) -> bool:
    """Only a terminal, and not if the user set NO_COLOR (no-color.org)."""
    return stream.isatty() and not environment.get("NO_COLOR") and environment.get("TERM") != "dumb"


class Report:
    """Writes findings as text, as they come. Devices and files put no control character into it."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout
        self._color = wants_color(self._stream, os.environ)
        on_terminal = self._stream.isatty()
        width = shutil.get_terminal_size((_USUAL_WIDTH, 24)).columns if on_terminal else _USUAL_WIDTH
        self._width = max(_LEAST_TEXT, width - len(_INDENT))
        self._subject, self._waiting = "", False

    def say(self, text: str) -> None:
        """One line, in place of what `wait` shows."""
        self._stream.write("\x1b[K" * self._waiting + text + "\n")
        self._stream.flush()
        self._waiting = False

    def wait(self, text: str) -> None:
        """Show progress on a terminal, until the next line."""
        if self._stream.isatty():
            self._stream.write(f"{text}\r")
            self._stream.flush()
            self._waiting = True

    def write(self, finding: CheckResult) -> None:
        if finding.subject != self._subject:
            self.say(("\n" if self._subject else "") + self._painted(finding.subject, "\x1b[1m"))
            self._subject = finding.subject
        first, *rest = self._lines(finding.found) or [""]
        level = self._painted(NAMES[finding.level].ljust(_LEVEL_WIDTH), _COLORS[finding.level])
        self.say(f"  {level}  {finding.check.ljust(_NAME_WIDTH)}  {first}")
        for line in (*rest, *self._lines(finding.why), *(f"$ {visible(each)}" for each in finding.commands)):
            self.say(_INDENT + line)

    def summary(self, findings: Sequence[CheckResult]) -> None:
        """The verdict, with what matters once more, for the rest may have scrolled away."""
        counts = {level: sum(f.level is level for f in findings) for level in reversed(NAMES)}
        text = ", ".join(f"{count} {_counted(level, count)}" for level, count in counts.items() if count)
        words = self._painted(verdict(findings).words.capitalize(), _COLORS[worst(findings)])
        self.say(f"\n{words}: {text}")
        matters = sorted((f for f in findings if f.level >= Level.LOOK), key=lambda f: -f.level)
        for each in matters[:_MOST_REPEATED]:
            name = NAMES[each.level].ljust(_LEVEL_WIDTH)
            lines = textwrap.wrap(
                f"  {name}  {each.subject}, {each.check}: {each.found}", self._width + len(_INDENT),
                subsequent_indent=" " * (4 + _LEVEL_WIDTH), max_lines=2, placeholder=" ...",
            )  # fmt: skip
            self.say("\n".join(map(visible, lines)))
        if len(matters) > _MOST_REPEATED:
            self.say(f"  and {len(matters) - _MOST_REPEATED} more above")

    def _lines(self, text: str) -> list[str]:
        found = textwrap.wrap(text, self._width, break_on_hyphens=False, break_long_words=False)
        return [visible(line) for line in found]

    def _painted(self, text: str, color: str) -> str:
        return f"{color}{text}\x1b[0m" if self._color else text


def _counted(level: Level, count: int) -> str:
    return f"{NAMES[level]}s" if level in {Level.NOTE, Level.LOOK} and count != 1 else NAMES[level]
