"""What a check finds: one line each, how much it matters, and what mends it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NoReturn


class Level(IntEnum):
    """How much a finding matters; the worst one is the doctor's exit code."""

    OK = 0
    SKIPPED = 1
    """Could not be looked at, or not by this user: says nothing about the machine."""
    NOTE = 2
    """Costs little, or only under load."""
    WARNING = 3
    """Costs samples or makes them older."""
    BAD = 4
    """The sensors cannot be read, or not reliably."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the doctor's."""

    level: Level
    found: str
    """What was found."""
    why: str = ""
    """Why it matters, and what to do where no command does it."""
    commands: tuple[str, ...] = ()
    """What mends it."""
    values: dict[str, Any] = field(default_factory=dict)
    """The same for programs."""
    subject: str = ""
    check: str = ""

    def as_json(self) -> dict[str, Any]:
        """For programs."""
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
    """A check cannot be done here; the text says why."""


def cannot_look(why: str) -> NoReturn:
    """End a check that cannot be done."""
    raise CannotLookError(why)


def ok(found: str, why: str = "", /, **values: Any) -> Finding:
    """All is well."""
    return Finding(Level.OK, found, why, (), values)


def note(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Costs little, or only under load."""
    return Finding(Level.NOTE, found, why, commands, values)


def warning(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Costs samples or makes them older."""
    return Finding(Level.WARNING, found, why, commands, values)


def bad(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """The sensors cannot be read, or not reliably."""
    return Finding(Level.BAD, found, why, commands, values)


def skipped(why: str) -> Finding:
    """Not looked at."""
    return Finding(Level.SKIPPED, f"could not look: {why}")
