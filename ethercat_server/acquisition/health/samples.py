"""What a sensor's samples show of it, looked at once a second: a wrong rate, silence, NaN and infinity.

Each is logged when it begins and when it ends, so a sensor that does it all the time makes two lines.
"""

from __future__ import annotations

import logging
from typing import Final

from ethercat_server.acquisition.clock import PLAUSIBLE_PULL, SampleClock
from ethercat_server.acquisition.slave_clock import Verdict

# Time for which the rate must deviate before it is reported: a busy machine distorts it for a moment.
_DEVIATING_SECONDS: Final = 10
# Seconds with finite samples only after which it is over.
_FINITE_SECONDS: Final = 10

log = logging.getLogger(__name__)


class SampleHealth:
    """Of the sensor `number`. `check` is to be called once a second."""

    def __init__(self, number: int) -> None:
        self._number = number
        self.not_finite = 0
        """New samples with a number that is NaN or infinite."""
        self._checked = (0, 0, 0)
        """The counts of the last check: fresh, repeated, not finite."""
        self._silent_s = 0
        self._finite_s = _FINITE_SECONDS
        self._rate_reported = False
        self._trusted = self._distrusted = False
        """Whether it was reported last that event times date the samples; that they do not."""
        self._deviating_s = 0

    def check(self, fresh: int, repeated: int, clock: SampleClock) -> None:
        """What the last second showed; `fresh` and `repeated` count frames since the start."""
        now = fresh, repeated, self.not_finite
        new, repeats, not_finite = (count - before for count, before in zip(now, self._checked, strict=True))
        self._checked = now
        self._check_silence(new, repeats)
        self._check_numbers(new, not_finite)
        self._check_rate(clock)
        self._check_events(clock)

    def _check_silence(self, new: int, repeats: int) -> None:
        if new:
            if self._silent_s:
                log.info("sensor %d gives new samples again after %d s", self._number, self._silent_s)
            self._silent_s = 0
        elif repeats or self._silent_s:  # neither: it is lost, which is reported as such
            self._silent_s += 1
            if self._silent_s == 1:
                log.warning(
                    "sensor %d gives nothing new: it is in OP but repeats the same sample; power cycle it",
                    self._number,
                )

    def _check_numbers(self, new: int, not_finite: int) -> None:
        if not_finite:
            if self._finite_s >= _FINITE_SECONDS:
                log.warning(
                    "sensor %d measures NaN or infinity: %d of its last %d samples; power cycle it",
                    self._number, not_finite, new,
                )  # fmt: skip
            self._finite_s = 0
        elif new and self._finite_s < _FINITE_SECONDS:
            self._finite_s += 1
            if self._finite_s == _FINITE_SECONDS:
                log.info(
                    "sensor %d measures finite numbers again; %d samples were not",
                    self._number,
                    self.not_finite,
                )

    def _check_rate(self, clock: SampleClock) -> None:
        """Say once if the sensor samples at another rate than it is set to."""
        pull = clock.estimate.pull
        deviates = clock.locked and abs(pull) > PLAUSIBLE_PULL
        self._deviating_s = self._deviating_s + 1 if deviates else 0
        if self._deviating_s == _DEVIATING_SECONDS and not self._rate_reported:
            self._rate_reported = True
            log.warning(
                "sensor %d samples every %.1f µs, %+.1f %% off what it is set to: check its settings",
                self._number, clock.period_ns / 1000, 100 * pull,
            )  # fmt: skip

    def _check_events(self, clock: SampleClock) -> None:
        """Say when the slave controller time-stamps the samples, and when it no longer does."""
        if clock.events is None:
            return
        trust = clock.events.trust
        if trust.verdict is Verdict.TRUSTED:
            if not self._trusted:
                log.info(
                    "sensor %d: its samples are time-stamped by the distributed clock of its slave "
                    "controller%s",
                    self._number, " again" if self._distrusted else "",
                )  # fmt: skip
            self._trusted, self._distrusted = True, False
        elif trust.verdict is Verdict.REFUSED and not self._distrusted:
            log.log(
                logging.WARNING if self._trusted else logging.INFO,
                "sensor %d: its samples are time-stamped by polling, for its slave controller's event times "
                "are unusable: %s",
                self._number, trust.why,
            )  # fmt: skip
            self._trusted, self._distrusted = False, True
