"""Whether event times are to be believed: they prove right in a trial, and have to go on doing so.

In a trial samples are dated by polling, and the event times compared with that. Once they are trusted, a few
that contradict the frames or the sensor's clock suffice for another trial.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Final, NamedTuple

_SAMPLES: Final = 100
_TRIAL_NS: Final = 500_000_000
"""Minimum samples and duration of a trial."""
_FITTING: Final = 0.99
"""Part of them whose events must lie between the frames around the sample. All are in the same clock, so
right ones always do. One that is off at random does not only where a poll came close, as one in ten does."""
_CONTRADICTS: Final = 3.0
"""Standard deviations by which the mean difference from polling may deviate."""
_MOST_FAILURES: Final = 5
"""Failed trials after which event times are not used, for a while."""
_FIRST_PAUSE_NS: Final = 10_000_000_000
_LONGEST_PAUSE_NS: Final = 320_000_000_000
"""That while at first, and at most: it doubles with each trial that fails after it."""
_PROVEN_NS: Final = 60_000_000_000
"""Time trusted after which earlier failures are forgotten."""
_RESTARTS: Final = 3
"""Restarts of the local clock in one trial beyond which it counts as not running."""
_MOST_CONTRADICTIONS: Final = 4.0
_FORGET: Final = 1 / 100
"""Contradictions at which the trust ends; each sample that fits takes `_FORGET` back."""


class Verdict(Enum):
    """What event times are worth."""

    TRIAL = "on trial"
    TRUSTED = "trusted"
    REFUSED = "refused"


class Evidence(NamedTuple):
    """What is known of the local clock, and of the events, when a trial begins or ends."""

    restarts: int
    """How often the clock was found to be another."""
    moved: int
    """Number of samples with an event of their own."""


class Trust:
    """In the event times of one sensor. Times in ns, variances in ns²."""

    __slots__ = (
        "_again_ns", "_began", "_compared", "_contradictions", "_failures", "_pause_ns", "_since_ns",
        "_squares", "_sum_ns", "_unfit", "is_final", "verdict", "was_trusted", "why",
    )  # fmt: skip

    def __init__(self) -> None:
        self.verdict = Verdict.TRIAL
        self.why = ""
        """What was wrong with them last: part of a sentence."""
        self.is_final = False
        """Whether they are refused for good: the controller has never shown any."""
        self.was_trusted = False
        """Whether this controller's ever were: then they are not refused for good."""
        self._failures = self._again_ns = 0
        self._pause_ns = _FIRST_PAUSE_NS
        self._contradictions = 0.0
        self._since_ns = 0
        self._began = Evidence(0, 0)
        self._compared = self._unfit = 0
        self._sum_ns = self._squares = 0.0

    def confirmed(self) -> None:
        """A sample is dated by its event."""
        if self._contradictions > 0:
            self._contradictions -= _FORGET

    def contradicted(self, weight: float) -> None:
        """A sample has no event that can be its own, or that agrees with the sensor's clock."""
        self._contradictions += weight

    def reconsider(self, evidence: Evidence, now_ns: int) -> None:
        """End the trust if there were too many contradictions."""
        if self._contradictions > _MOST_CONTRADICTIONS:
            if now_ns - self._since_ns > _PROVEN_NS:
                self._failures, self._pause_ns = 0, _FIRST_PAUSE_NS
            self._fail("they contradict the frames or the sensor's own clock", now_ns)
            self.begin(evidence, now_ns)

    def begin(self, evidence: Evidence, now_ns: int) -> None:
        """Begin a trial."""
        self._since_ns, self._began = now_ns, evidence
        self._compared = self._unfit = 0
        self._sum_ns = self._squares = 0.0

    def is_due(self, now_ns: int) -> bool:
        """Whether they are refused, and the pause has passed: they are to be tried again."""
        return self.verdict is Verdict.REFUSED and not self.is_final and now_ns >= self._again_ns

    def retry(self) -> None:
        """Have another trial begin, though they are refused."""
        self.verdict, self._since_ns = Verdict.TRIAL, 0

    def compare(self, difference_ns: float) -> None:
        """An event is so much later than what polling says."""
        self._compared += 1
        self._sum_ns += difference_ns
        self._squares += difference_ns * difference_ns

    @property
    def mean_ns(self) -> float:
        """By how much events were later than what polling says, in the latest trial."""
        return self._sum_ns / max(self._compared, 1)

    def unfit(self) -> None:
        """An event that cannot be the sample's."""
        self._unfit += 1

    def end(self, evidence: Evidence, variance: float, now_ns: int) -> float:
        """End the trial if it was long enough; `variance` is that of both estimates.

        Returns the variance of the differences between them if they are trusted now, else 0.
        """
        if self.verdict is Verdict.REFUSED:
            return 0.0
        if not self._since_ns:
            self.begin(evidence, now_ns)
        if now_ns - self._since_ns < _TRIAL_NS:
            return 0.0
        count = self._compared + self._unfit
        if evidence.restarts - self._began.restarts > _RESTARTS:
            self._refuse("its local clock does not run", now_ns)
            self.is_final = not self.was_trusted
        elif count < _SAMPLES:
            pass
        elif evidence.moved == self._began.moved:
            self._refuse("they stand still", now_ns)
            self.is_final = not self.was_trusted
        elif self._compared < _FITTING * count:
            self._fail("they contradict the frames", now_ns)
            self.begin(evidence, now_ns)
        elif abs(self.mean_ns) > _CONTRADICTS * math.sqrt(variance):
            self._fail(f"they differ from what polling shows by {self.mean_ns / 1000:+.0f} µs", now_ns)
            self.begin(evidence, now_ns)
        else:
            self.verdict, self._since_ns = Verdict.TRUSTED, now_ns
            self.was_trusted = True
            self._contradictions = 0.0
            return self._squares / self._compared
        return 0.0

    def _fail(self, why: str, now_ns: int) -> None:
        self._failures += 1
        self.verdict, self.why = Verdict.TRIAL, why
        if self._failures >= _MOST_FAILURES:
            self._refuse(why, now_ns)

    def _refuse(self, why: str, now_ns: int) -> None:
        self.verdict, self.why = Verdict.REFUSED, why
        self._again_ns, self._pause_ns = now_ns + self._pause_ns, min(2 * self._pause_ns, _LONGEST_PAUSE_NS)
