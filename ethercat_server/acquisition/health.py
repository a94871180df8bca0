"""What is checked once a second while the bus runs: a slow network card, what the samples show of a sensor.

A wrong rate, silence, NaN and infinity are logged when they begin and when they end, so that a sensor which
does it all the time makes two lines.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Final

from bota_ethercat.pdo import is_finite, layout_for
from ethercat_server.ethercat.bus import Bus
from ethercat_server.sampling.constants import PERIOD_ERROR
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock
from ethercat_server.sampling.trust import TrustState

SLOW_US: Final = 300.0  # a usual round trip above this is a slow network card's, or a slow driver's
_PCIE_US: Final = 100.0  # a usual round trip through a PCIe card, system calls included
_SLOW_SECONDS: Final = 5

log = logging.getLogger(__name__)


def cost(usual_us: float) -> str:
    """What a slow round trip costs, as part of a sentence."""
    return f"samples are {(usual_us - _PCIE_US) / 2:.0f} µs older than through a PCIe network card"


class RoundTripHealth:
    """Logs once that round trips on `bus` are slow; call `check` once a second."""

    def __init__(self, round_trip: RoundTrip, bus: Bus) -> None:
        self._round_trip = round_trip
        self._bus = bus
        self._slow_s = 0

    def check(self) -> None:
        usual_us = self._round_trip.usual_ns / 1000
        if self._slow_s < _SLOW_SECONDS:
            self._slow_s = self._slow_s + 1 if usual_us > SLOW_US else 0
            if self._slow_s == _SLOW_SECONDS:
                log.info("frames take %.0f µs through %s: %s", usual_us, self._bus.ifname, cost(usual_us))


# Time for which the rate must deviate before it is reported: a busy machine distorts it for a moment.
_DEVIATING_SECONDS: Final = 10
_FINITE_SECONDS: Final = 10  # seconds with finite samples only after which it is over


class SampleHealth:
    """What the samples of the sensor `number` show of it; call `check` once a second.

    `on_samples` is called with those that are finite, by field.
    """

    def __init__(self, number: int, on_samples: Callable[[Sequence[Sequence[float]]], object]) -> None:
        self._number = number
        self.not_finite = 0  # new samples with a number that is NaN or infinite
        self._on_samples = on_samples
        self._checked = (0, 0, 0)  # the counts of the last check: fresh, repeated, not finite
        self._silent_s = 0
        self._finite_s = _FINITE_SECONDS
        self._rate_reported = False
        self._reported: TrustState | None = None  # of event times, what was reported last
        self._deviating_s = 0

    def count(self, newest: Sequence[bytes]) -> None:
        """Count the new samples that are not finite; of at least one, the process data."""
        columns = list(zip(*layout_for(len(newest[0])).struct.iter_unpack(b"".join(newest)), strict=True))
        # An infinity or a NaN survives the sum, so that one look is enough for all of them.
        if math.isfinite(sum(map(sum, columns))):
            self._on_samples(columns)
        else:
            self.not_finite += sum(not is_finite(each) for each in newest)

    def check(self, fresh: int, repeated: int, clock: SampleClock) -> None:
        """Check the last second; `fresh` and `repeated` count frames since the start."""
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
        """Log once that the sensor samples at another rate than it is set to."""
        error = clock.phase.period_error
        deviates = clock.locked and abs(error) > 2 * PERIOD_ERROR
        self._deviating_s = self._deviating_s + 1 if deviates else 0
        if self._deviating_s == _DEVIATING_SECONDS and not self._rate_reported:
            self._rate_reported = True
            log.warning(
                "sensor %d samples every %.1f µs, %+.1f %% off what it is set to: check its settings",
                self._number, clock.period_ns / 1000, 100 * error,
            )  # fmt: skip

    def _check_events(self, clock: SampleClock) -> None:
        """Log when the slave controller time-stamps the samples, and when it no longer does."""
        if clock.events is None:
            return
        state, before = clock.events.trust.state, self._reported
        if state in (TrustState.TRIAL, before):
            return
        self._reported = state
        if state is TrustState.TRUSTED:
            log.info(
                "sensor %d: its samples are time-stamped by the distributed clock of its slave controller%s",
                self._number, "" if before is None else " again",
            )  # fmt: skip
        else:
            log.log(
                logging.INFO if before is None else logging.WARNING,
                "sensor %d: its samples are time-stamped by polling, for its slave controller's event times "
                "are unusable: %s",
                self._number, clock.events.trust.why,
            )  # fmt: skip
