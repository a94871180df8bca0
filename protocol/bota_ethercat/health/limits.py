# SPDX-License-Identifier: Apache-2.0
"""The limits of every verdict on a stream, in one table (for people: docs/programs.md); levels, findings."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum, IntEnum
from typing import Final, NamedTuple


class StreamLimits(NamedTuple):
    """Limits of a stream; the node's parameters `diagnostics.*` replace those that have one."""

    stale_after: float = 0.5  # seconds without a new sample that are trouble
    rate_tolerance: float = 0.01  # relative deviation from the nominal rate that is worth a look
    rate_error: float = 0.2  # the same, as trouble: these are not the filters of the settings
    age_warn: float = 0.01  # age of the samples on arrival (p99), s, that is worth a look
    age_error: float = 0.1  # the same, as trouble
    lost_warn: int = 1  # lost samples, or invalid frames, that are worth a look
    lost_error: float = 0.005  # share of lost samples, or invalid frames, above which they are trouble
    # The time that they must amount to, too: one short stall is not trouble, however short the observation.
    lost_error_s: float = 0.05
    temperature_warn: float = 60.0  # °C
    temperature_error: float = 80.0
    coldest: float = -40.0  # °C that the electronics cannot have
    drift_force: float = 1.0  # N of drift since the tare that are worth a look
    drift_torque: float = 0.05  # Nm
    emergency_s: float = 60.0  # how long an emergency of the sensor is worth a look
    # Share of a period that 5 % of the intervals may deviate by: beyond it the clock is not followed.
    irregular: float = 0.2


LIMITS: Final = StreamLimits()  # what holds unless somebody sets something else


class Level(IntEnum):
    """How bad something is. A verdict is GOOD, LOOK or TROUBLE; the others are those of a single check."""

    GOOD = 0
    NOT_APPLICABLE = 1  # there is nothing to check, for example because the IMU is off
    NOT_POSSIBLE = 2  # it could not be checked
    NOTE = 3  # of little effect
    LOOK = 4  # needs attention; the data can be used
    TROUBLE = 5  # the data cannot be trusted, or there is none

    @property
    def words(self) -> str:
        """For people."""
        return "worth a look" if self is Level.LOOK else self.name.lower().replace("_", " ")

    @property
    def key(self) -> str:
        """For programs, and for style sheets."""
        return self.name.lower().replace("_", "-")

    @property
    def symbol(self) -> str:
        """A symbol beside the words, so that nothing depends on color."""
        return "✓-?i!✗"[self]


class About(Enum):
    """What a finding is about."""

    STREAM = "stream"
    SENSOR = "sensor"
    CLOCK = "clock"
    LINK = "link"


class Finding(NamedTuple):
    """One thing that is not as it should be."""

    level: Level
    about: About
    key: str  # the same for the same thing at another time
    found: str  # a clause that begins with a capital and has no full stop
    remedy: str  # what to do: likewise
    size: float = 0.0  # how much of it there is, to compare it with the same at another time

    @property
    def sentence(self) -> str:
        """Both."""
        return f"{self.found}: {self.remedy[0].lower()}{self.remedy[1:]}"


class Verdict(NamedTuple):
    """What all findings come to."""

    level: Level
    findings: tuple[Finding, ...]  # the worst first

    @property
    def headline(self) -> str:
        """Good, Worth a look or Trouble."""
        return self.level.words.capitalize()

    @property
    def sentence(self) -> str:
        """The most important finding."""
        return self.findings[0].sentence if self.findings else "Nothing is wrong with the stream"

    def __str__(self) -> str:
        return f"{self.headline}: {self.sentence}"


NOTHING_WRONG: Final = Verdict(Level.GOOD, ())


def verdict(findings: Iterable[Finding]) -> Verdict:
    """The worst decides; findings of one level stay in order."""
    ordered = tuple(sorted(findings, key=lambda finding: -finding.level))
    return Verdict(ordered[0].level if ordered else Level.GOOD, ordered)
