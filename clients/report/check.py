"""What a check of the report says: how bad it is, what was found, whether it matters, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """How bad, worst last."""

    OK = 0
    NOT_APPLICABLE = 1
    """There is nothing to check: the IMU is off, say. No reason not to call a sensor healthy."""
    NOT_POSSIBLE = 2
    """It should have been checked and could not be."""
    ATTENTION = 3
    """Look at it; the data can be used."""
    FAULT = 4
    """The data cannot be trusted, or the sensor needs something done."""

    @property
    def word(self) -> str:
        """For people."""
        return _WORDS[self][0]

    @property
    def symbol(self) -> str:
        """A sign beside the word, so that a page can be skimmed without colours."""
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
    """What all checks come to."""

    level: Level
    """OK, NOT_POSSIBLE, ATTENTION or FAULT."""
    sentence: str

    @property
    def headline(self) -> str:
        """One or two words."""
        return HEADLINES[self.level]


def verdict(checks: Sequence[Check]) -> Verdict:
    """The worst of the checks decides; healthy is only what could be checked in every respect."""
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
    sentence = "Every check was made and nothing was found."
    if left_out:
        sentence = f"Nothing was found in every check that applies. Not applicable: {_names(left_out)}."
    return Verdict(Level.OK, sentence)


def _names(checks: Sequence[Check]) -> str:
    return ", ".join(check.name.lower().replace("imu", "IMU") for check in checks)
