"""The result of a check: severity, what was found, why it matters, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from protocol.health.verdict import Finding, Level


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


def judged(
    name: str, findings: Sequence[Finding], good: str, *, details: str = "", matters: str = "",
    remedy: str = "",
) -> Check:  # fmt: skip
    """What the judge of streams found, with more `details` and `remedy`; `good` if it found nothing."""
    if not findings:
        return Check(name, Level.GOOD, good)
    found = " ".join([*(f"{each.found}." for each in findings), *([details] if details else [])])
    remedies = dict.fromkeys([*(f"{each.remedy}." for each in findings), *([remedy] if remedy else [])])
    return Check(name, findings[0].level, found, matters, " ".join(remedies))


@dataclass(frozen=True, slots=True)
class Verdict:
    """The overall result."""

    level: Level
    """GOOD, NOT_POSSIBLE, LOOK or TROUBLE."""
    sentence: str

    @property
    def headline(self) -> str:
        """One or two words."""
        return "Not conclusive" if self.level is Level.NOT_POSSIBLE else self.level.words.capitalize()


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
