"""Whether event times are to be believed: they prove right in a trial, and have to go on doing so.

In a trial samples are dated by polling, and the event times compared with that. Once they are trusted, a few
that contradict the frames or the sensor's clock suffice for another trial.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, Protocol

_SAMPLES: Final = 100
_TRIAL_NS: Final = 500_000_000
"""A trial takes so many samples and so long."""
_AGREEING: Final = 0.95
"""Part of them that must agree with polling."""
_CONTRADICTS: Final = 3.0
"""One that is off by more than so many standard deviations does not."""
_OUTLIER: Final = 5.0
"""Once trusted, one that is off by so many is not used."""
_LEAST_SPREAD: Final = 2_000.0**2
_SPREAD_GAIN: Final = 1 / 64
_MOST_FAILURES: Final = 5
"""After so many event times are not used any more."""
_PROVEN_NS: Final = 60_000_000_000
"""Trusted for so long, they have a clean record."""
_RESTARTS: Final = 3
"""A local clock that starts anew so often in a trial is none."""
_MOST_CONTRADICTIONS: Final = 4.0
_FORGET: Final = 1 / 64
"""The trust ends with so many, of which each sample that fits takes back this part of one."""


class Verdict(Enum):
    """What event times are worth."""

    TRIAL = "on trial"
    TRUSTED = "trusted"
    REFUSED = "refused"


class Evidence(Protocol):
    """What the newest sample's event says: see `EventTimes`."""

    instant_ns: float
    fits: bool
    moved: int

    @property
    def restarts(self) -> int:
        """How often the local clock was found to be another."""


class Trust:
    """In the event times of one sensor. Times in ns, variances in ns²."""

    __slots__ = (
        "_agreed", "_compared", "_contradictions", "_differences_ns", "_failures", "_moved", "_restarts",
        "_since_ns", "spread", "verdict", "why",
    )  # fmt: skip

    def __init__(self) -> None:
        self.verdict = Verdict.TRIAL
        self.why = ""
        """What was wrong with them last: part of a sentence."""
        self.spread = _LEAST_SPREAD
        """Variance of the instants about those of a clock that runs evenly."""
        self._failures = 0
        self._contradictions = 0.0
        self._since_ns = 0
        self._compared = self._agreed = self._moved = self._restarts = 0
        self._differences_ns = 0.0

    def keeps(self, event: Evidence, difference_ns: float, variance: float, back_ns: int) -> bool:
        """Whether a sample is dated by its event, which is so far from the estimate of this variance."""
        if event.instant_ns:
            square, most = difference_ns * difference_ns, _OUTLIER * _OUTLIER * (variance + self.spread)
            fits = square < most
            self.spread += _SPREAD_GAIN * ((square if fits else most) - self.spread)
            self.spread = max(self.spread, _LEAST_SPREAD)
            if fits:
                if self._contradictions > 0:
                    self._contradictions -= _FORGET
                return True
        elif event.fits:  # its local clock is not known
            return False
        self._contradictions += 1
        if self._contradictions > _MOST_CONTRADICTIONS:
            if back_ns - self._since_ns > _PROVEN_NS:
                self._failures = 0
            self._fail("they contradict the frames and the sensor's clock")
            self._begin(event, back_ns)
        return False

    def tries(self, event: Evidence, difference_ns: float, variance: float, back_ns: int) -> None:
        """Compare a sample's event with the estimate by polling."""
        if not self._since_ns:
            self._begin(event, back_ns)
        if event.instant_ns or not event.fits:
            self._compared += 1
            if event.instant_ns:
                self._differences_ns += difference_ns
                most = _CONTRADICTS * _CONTRADICTS * (variance + self.spread)
                self._agreed += difference_ns * difference_ns < most
        if back_ns - self._since_ns > _TRIAL_NS:
            if event.restarts - self._restarts > _RESTARTS:
                self._refuse("its local clock does not run")
            elif self._compared >= _SAMPLES:
                self._end(event, back_ns)

    def _begin(self, event: Evidence, now_ns: int) -> None:
        self._since_ns = now_ns
        self._compared = self._agreed = 0
        self._differences_ns = 0.0
        self._moved, self._restarts = event.moved, event.restarts

    def _end(self, event: Evidence, back_ns: int) -> None:
        if self._agreed >= _AGREEING * self._compared:
            self.verdict, self._since_ns = Verdict.TRUSTED, back_ns
            self._contradictions = 0.0
        elif event.moved == self._moved:
            self._refuse("they stand still")
        else:
            off_us = self._differences_ns / self._compared / 1000
            self._fail(f"they differ from what polling shows by {off_us:+.0f} µs")
            self._begin(event, back_ns)

    def _fail(self, why: str) -> None:
        self._failures += 1
        self.verdict, self.why = Verdict.TRIAL, why
        if self._failures >= _MOST_FAILURES:
            self._refuse(why)

    def _refuse(self, why: str) -> None:
        self.verdict, self.why = Verdict.REFUSED, why
