"""The result of a check: severity, description, and the commands that fix it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NoReturn


class Level(IntEnum):
    """Severity; the worst one determines the exit code."""

    OK = 0
    SKIPPED = 1
    """Could not be checked, or not by this user."""
    NOTE = 2
    """Little effect, or only under load."""
    WARNING = 3
    """Loses samples or increases their age."""
    BAD = 4
    """Sensors cannot be read, or not reliably."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    level: Level
    found: str
    """Description."""
    why: str = ""
    """Its effect, and the remedy where no command is one."""
    commands: tuple[str, ...] = ()
    """Commands that fix it."""
    values: dict[str, Any] = field(default_factory=dict)
    """Details for the JSON output."""
    subject: str = ""
    check: str = ""

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {
            "subject": self.subject,
            "check": self.check,
            "level": self.level.name.lower(),
            "found": self.found,
            "why": self.why,
            "commands": list(self.commands),
            "values": self.values,
        }


class CannotLookError(Exception):
    """A check is impossible here; the text says why."""


def cannot_look(why: str) -> NoReturn:
    """End an impossible check."""
    raise CannotLookError(why)


def ok(found: str, why: str = "", /, **values: Any) -> Finding:
    """Nothing to fix."""
    return Finding(Level.OK, found, why, (), values)


def note(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Little effect, or only under load."""
    return Finding(Level.NOTE, found, why, commands, values)


def warning(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Loses samples or increases their age."""
    return Finding(Level.WARNING, found, why, commands, values)


def bad(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Sensors cannot be read, or not reliably."""
    return Finding(Level.BAD, found, why, commands, values)


def skipped(why: str) -> Finding:
    """Not checked."""
    return Finding(Level.SKIPPED, f"not checked: {why}")
