"""The result of a check: severity, what was found, why it matters, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """Severity, worst last."""

    OK = 0
    NOT_APPLICABLE = 1
    """There is nothing to check, for example because the IMU is off; a sensor can still be healthy."""
    NOT_POSSIBLE = 2
    """It could not be checked."""
    ATTENTION = 3
    """Needs attention; the data can be used."""
    FAULT = 4
    """The data cannot be trusted, or the sensor needs service."""

    @property
    def key(self) -> str:
        """For programs, and for style sheets."""
        return self.name.lower().replace("_", "-")

    @property
    def word(self) -> str:
        """For people."""
        return _WORDS[self][0]

    @property
    def symbol(self) -> str:
        """A symbol beside the word, so that nothing depends on color."""
        return _WORDS[self][1]


_WORDS = {
    Level.OK: ("ok", "✓"),
    Level.NOT_APPLICABLE: ("not applicable", "-"),
    Level.NOT_POSSIBLE: ("not possible", "?"),
    Level.ATTENTION: ("attention", "!"),
    Level.FAULT: ("fault", "✗"),
}


@dataclass(frozen=True, slots=True)
class Check:
    """One check and its outcome. Texts are plain; whoever shows them escapes them."""

    name: str
    level: Level
    found: str
    """What was found, with figures."""
    matters: str = ""
    """Why it matters; empty where nothing is wrong."""
    remedy: str = ""
    """What to do; empty where nothing is wrong."""


HEADLINES = {
    Level.OK: "Healthy",
    Level.NOT_POSSIBLE: "Not conclusive",
    Level.ATTENTION: "Attention",
    Level.FAULT: "Fault",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The overall result."""

    level: Level
    """OK, NOT_POSSIBLE, ATTENTION or FAULT."""
    sentence: str

    @property
    def headline(self) -> str:
        """One or two words."""
        return HEADLINES[self.level]


def verdict(checks: Sequence[Check]) -> Verdict:
    """The worst check decides; only a sensor that could be checked completely is healthy."""
    wrong = [check for check in checks if check.level >= Level.ATTENTION]
    unchecked = [check for check in checks if check.level is Level.NOT_POSSIBLE]
    left_out = [check for check in checks if check.level is Level.NOT_APPLICABLE]
    not_checked = f"It could not be checked: {_names(unchecked)}." if unchecked else ""
    if wrong:
        worst = max(check.level for check in wrong)
        found = f"{len(wrong)} of {len(checks)} checks found something: {_names(wrong)}."
        return Verdict(worst, f"{found} {not_checked}".rstrip())
    if unchecked:
        return Verdict(
            Level.NOT_POSSIBLE, f"Nothing wrong was found, but not everything was checked. {not_checked}"
        )
    sentence = "All checks passed."
    if left_out:
        sentence = f"All applicable checks passed. Not applicable: {_names(left_out)}."
    return Verdict(Level.OK, sentence)


def _names(checks: Sequence[Check]) -> str:
    return ", ".join(check.name.lower().replace("imu", "IMU") for check in checks)
