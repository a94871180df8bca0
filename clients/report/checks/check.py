"""The result of a check: severity, what was found, why it matters, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from protocol.health import verdict as health


class Level(IntEnum):
    """Severity, worst last."""

    GOOD = 0
    NOT_APPLICABLE = 1
    """There is nothing to check, for example because the IMU is off; a sensor can still be healthy."""
    NOT_POSSIBLE = 2
    """It could not be checked."""
    LOOK = 3
    """Needs attention; the data can be used."""
    TROUBLE = 4
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
    Level.GOOD: (health.Level.GOOD.words, "✓"),
    Level.NOT_APPLICABLE: ("not applicable", "-"),
    Level.NOT_POSSIBLE: ("not possible", "?"),
    Level.LOOK: (health.Level.LOOK.words, "!"),
    Level.TROUBLE: (health.Level.TROUBLE.words, "✗"),
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


OF_STREAM: Final = {health.Level.LOOK: Level.LOOK, health.Level.TROUBLE: Level.TROUBLE}
"""Levels of what the judge of streams found."""


def judged(
    name: str, findings: Sequence[health.Finding], good: str, *, details: str = "", matters: str = "",
    remedy: str = "",
) -> Check:  # fmt: skip
    """What the judge of streams found, with more `details` and `remedy`; `good` if it found nothing."""
    if not findings:
        return Check(name, Level.GOOD, good)
    found = " ".join([*(f"{each.found}." for each in findings), *([details] if details else [])])
    remedies = dict.fromkeys([*(f"{each.remedy}." for each in findings), *([remedy] if remedy else [])])
    return Check(name, OF_STREAM[findings[0].level], found, matters, " ".join(remedies))


HEADLINES = {
    Level.GOOD: health.Level.GOOD.words.capitalize(),
    Level.NOT_POSSIBLE: "Not conclusive",
    Level.LOOK: health.Level.LOOK.words.capitalize(),
    Level.TROUBLE: health.Level.TROUBLE.words.capitalize(),
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The overall result."""

    level: Level
    """GOOD, NOT_POSSIBLE, LOOK or TROUBLE."""
    sentence: str

    @property
    def headline(self) -> str:
        """One or two words."""
        return HEADLINES[self.level]


def verdict(checks: Sequence[Check]) -> Verdict:
    """The worst check decides; only a sensor that could be checked completely is healthy."""
    wrong = [check for check in checks if check.level >= Level.LOOK]
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
    return Verdict(Level.GOOD, sentence)


def _names(checks: Sequence[Check]) -> str:
    return ", ".join(check.name.lower().replace("imu", "IMU") for check in checks)
