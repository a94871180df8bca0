"""The result of a check: severity, description, and the commands that fix it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, NoReturn

from bota_ethercat.health.verdict import Level

# As the doctor calls the levels.
NAMES: Final = {
    Level.GOOD: "ok",
    Level.NOT_POSSIBLE: "skipped",
    Level.NOTE: "note",
    Level.LOOK: "warning",
    Level.TROUBLE: "bad",
}


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
            "level": NAMES[self.level],
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
    return Finding(Level.GOOD, found, why, (), values)


def note(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Little effect, or only under load."""
    return Finding(Level.NOTE, found, why, commands, values)


def warning(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Loses samples or increases their age."""
    return Finding(Level.LOOK, found, why, commands, values)


def bad(found: str, why: str, /, *commands: str, **values: Any) -> Finding:
    """Sensors cannot be read, or not reliably."""
    return Finding(Level.TROUBLE, found, why, commands, values)


def skipped(why: str) -> Finding:
    """Not checked."""
    return Finding(Level.NOT_POSSIBLE, f"not checked: {why}")
