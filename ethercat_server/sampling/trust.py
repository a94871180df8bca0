"""Whether the event times that a slave controller latches date samples: states in a table.

Event times are on trial first: polling dates the samples, and each event is compared with it. Trusted ones
lose the trust by contradictions, and after some failed trials there is a pause.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import Final

from ethercat_server.sampling.constants import CONTRADICTS, IN_A_ROW, TRIAL_NS, TRIAL_SAMPLES

_FIRST_PAUSE_NS: Final = 10_000_000_000  # of refused ones, at first; it doubles with each trial that fails
_LONGEST_PAUSE_NS: Final = 320_000_000_000
_PROVEN_NS: Final = 60_000_000_000  # time trusted after which earlier failures are forgotten


class TrustState(Enum):
    """Whether event times may date samples."""

    TRIAL = "on trial"
    TRUSTED = "trusted"
    REFUSED = "refused"
    ABSENT = "absent"  # the controller has never shown any


class Evidence(Enum):
    """What moves event times from one state to another."""

    FITS = auto()
    CONTRADICTS = auto()
    FAILS_AGAIN = auto()  # for the fifth time
    SHOWS_NONE = auto()  # the local clock or the events stand still
    IS_RETRIED = auto()


# Any other pair is a defect of this program.
TRANSITIONS: Final = {
    (TrustState.TRIAL, Evidence.FITS): TrustState.TRUSTED,
    (TrustState.TRIAL, Evidence.CONTRADICTS): TrustState.TRIAL,
    (TrustState.TRIAL, Evidence.FAILS_AGAIN): TrustState.REFUSED,
    (TrustState.TRIAL, Evidence.SHOWS_NONE): TrustState.ABSENT,
    (TrustState.TRUSTED, Evidence.CONTRADICTS): TrustState.TRIAL,
    (TrustState.TRUSTED, Evidence.FAILS_AGAIN): TrustState.REFUSED,
    (TrustState.REFUSED, Evidence.IS_RETRIED): TrustState.TRIAL,
}


class Trust:
    """Whether the event times of one sensor are believed.

    Attributes:
        state: whether they may date samples now.
        why: what was wrong with them last: part of a sentence.
        was_trusted: whether this controller's ever were: then they are not `ABSENT`.
        contradictions: evidence against trusted ones, in samples.
    """

    def __init__(self) -> None:
        self.state = TrustState.TRIAL
        self.why = ""
        self.was_trusted = False
        self.contradictions = 0.0
        self._failures = self._again_ns = 0
        self._pause_ns = _FIRST_PAUSE_NS
        self._begin(0, 0)

    def _begin(self, now_ns: int, restarts: int) -> None:
        """Begin a trial; with the first sample if `now_ns` is 0."""
        self._since_ns, self._restarts = now_ns, restarts
        self._events = self._compared = self._unfit = 0
        self._sum_ns = self._squares = 0.0

    def _enter(self, evidence: Evidence) -> None:
        self.state = TRANSITIONS[self.state, evidence]

    @property
    def is_trusted(self) -> bool:
        """Whether samples are dated by them."""
        return self.state is TrustState.TRUSTED

    @property
    def is_steady(self) -> bool:
        """Whether nothing is being found out about them, or held against them."""
        return self.state is not TrustState.TRIAL and self.contradictions <= 0

    def is_due(self, now_ns: int) -> bool:
        """Whether they are refused, and the pause has passed: they are to be tried again."""
        return self.state is TrustState.REFUSED and now_ns >= self._again_ns

    def retry(self) -> None:
        """Have another trial begin, though they are refused."""
        self._enter(Evidence.IS_RETRIED)
        self._begin(0, 0)

    def confirm(self) -> None:
        """A sample is dated by its event."""
        if self.contradictions > 0:
            self.contradictions -= 1 / TRIAL_SAMPLES

    def contradict(self, now_ns: int, restarts: int) -> None:
        """A sample has no event that can be its own, or none that agrees with the sensor's clock."""
        self.contradictions += 1
        if self.contradictions > IN_A_ROW:
            if now_ns - self._since_ns > _PROVEN_NS:
                self._failures, self._pause_ns = 0, _FIRST_PAUSE_NS
            self._fail("they contradict the frames or the sensor's own clock", now_ns, restarts)

    def compare(self, difference_ns: float | None, *, is_new: bool, counts: bool) -> None:
        """In a trial, an event is later than polling says; None if it cannot be the sample's.

        `is_new`: it is another one than that before. `counts`: whether one that cannot be is held against
        them.
        """
        self._events += is_new
        if difference_ns is not None:
            self._compared += 1
            self._sum_ns += difference_ns
            self._squares += difference_ns * difference_ns
        elif counts:
            self._unfit += 1

    @property
    def mean_ns(self) -> float:
        """Mean difference between events and polling in the latest trial."""
        return self._sum_ns / max(self._compared, 1)

    def judge(self, variance: float, now_ns: int, restarts: int) -> float:
        """End the trial if it was long enough; `variance` is that of both estimates.

        `restarts` of the local clock since its beginning. Returns the variance of the differences between
        events and polling if they are trusted now, else 0.
        """
        if self.state is not TrustState.TRIAL:
            return 0.0
        if not self._since_ns:
            self._begin(now_ns, restarts)
        if now_ns - self._since_ns < TRIAL_NS:
            return 0.0
        count = self._compared + self._unfit
        if restarts - self._restarts > IN_A_ROW:
            self._show_none("its local clock does not run", now_ns)
        elif count < TRIAL_SAMPLES:
            pass
        elif not self._events:
            self._show_none("they stand still", now_ns)
        elif self._unfit > count / TRIAL_SAMPLES:
            self._fail("they contradict the frames", now_ns, restarts)
        elif abs(self.mean_ns) > CONTRADICTS * math.sqrt(variance):
            why = f"they differ from what polling shows by {self.mean_ns / 1000:+.0f} µs"
            self._fail(why, now_ns, restarts)
        else:
            self._enter(Evidence.FITS)
            self._since_ns, self.was_trusted, self.contradictions = now_ns, True, 0.0
            return self._squares / self._compared
        return 0.0

    def _show_none(self, why: str, now_ns: int) -> None:
        self.why = why
        self._pause(now_ns)
        self._enter(Evidence.FAILS_AGAIN if self.was_trusted else Evidence.SHOWS_NONE)

    def _fail(self, why: str, now_ns: int, restarts: int) -> None:
        self._failures += 1
        self.why = why
        if self._failures > IN_A_ROW:
            self._pause(now_ns)
            self._enter(Evidence.FAILS_AGAIN)
        else:
            self._enter(Evidence.CONTRADICTS)
        self._begin(now_ns, restarts)

    def _pause(self, now_ns: int) -> None:
        self._again_ns, self._pause_ns = now_ns + self._pause_ns, min(2 * self._pause_ns, _LONGEST_PAUSE_NS)
