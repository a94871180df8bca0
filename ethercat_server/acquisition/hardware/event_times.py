"""When a sensor's samples came to be, by what its slave controller latches.

A controller with distributed clocks keeps its local time of the moment when the sensor's processor had
written a sample (PDI buffer change event). The frame that reads the sample reads that, too. Which sample an
event belongs to is certain: it came after the frame before, which did not bring the sample, and before this.
Where the next sample came between the pass of the process data and that of the event, its event says when.
"""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.acquisition.hardware.local_clock import LocalClock
from ethercat_server.acquisition.hardware.trust import Evidence, Trust, Verdict
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.ethercat.exchange.distributed_clock import DistributedClock, Latched

_WRAP: Final = 1 << 32
_HALF: Final = 1 << 31
_LONG_AGO: Final = -(1 << 63)
_SLACK_NS: Final = 5_000
"""Tolerance between the latched times of an event and of a frame's arrival."""
_OUTLIER: Final = 5.0
"""Standard deviations from the estimate beyond which an instant is not used."""
_OLDEST: Final = 1.5
"""Age of the newest event, in periods, beyond which samples have come without events."""
_LEAST_VARIANCE: Final = 3_000.0**2
_ASYMMETRY: Final = 1 / 24
"""Standard deviation of the outward part of a round trip, as part of the shortest one."""


class EventTimes:
    """Of one sensor. `took` follows every exchange; then, if it brought a new sample, `date` or `compare`;
    then `learn`."""

    __slots__ = (
        "_answers", "_event", "_half_behind_ns", "_is_next", "_local", "_moved", "_offset", "_passing_ns",
        "_reading_ns", "_timing", "_took_ns", "are_trusted", "instant_ns", "is_doubtful", "local_clock",
        "trust",
    )  # fmt: skip

    def __init__(self, clock: DistributedClock, timing: ExchangeTiming, passing_ns: int) -> None:
        """`clock` is the slave controller's; `timing` that of the bus.

        The process data passes so long after the frame has arrived.
        """
        self.local_clock = LocalClock(timing)
        self.trust = Trust()
        self.are_trusted = False
        """Whether samples are dated by them."""
        self.instant_ns = 0.0
        """CLOCK_MONOTONIC of the new sample of the newest exchange; 0 if its event does not say."""
        self._timing = timing
        self._use(clock)
        self._passing_ns = passing_ns
        self._local = self._event = _LONG_AGO
        """Local times of the newest exchange and of the newest sample's event."""
        self._took_ns = 0
        """By the newest exchange."""
        self.is_doubtful = False
        """Whether samples may have been lost before it that nobody knows of."""
        self._is_next = False
        """Whether that event is the next sample's, which came while the frame passed."""
        self._moved = 0
        self._answers = False
        """Whether the controller knows the registers."""

    def _use(self, clock: DistributedClock) -> None:
        self._offset = clock.offset
        self._half_behind_ns = clock.behind_ns / 2
        self._reading_ns = clock.reading_ns

    def retry(self, clock: DistributedClock) -> None:
        """Try them again: another master may have changed the controller's clock, which now is `clock`."""
        if clock.offset != self._offset:
            self.local_clock = LocalClock(self._timing)
        self._use(clock)
        self.trust.retry()

    @property
    def _is_in_time(self) -> bool:
        """Whether the newest exchange was no longer away than usual: else the machine was busy meanwhile."""
        return self._took_ns < self._timing.patience_ns

    @property
    def variance(self) -> float:
        """Of `instant_ns`, in ns², but for where on its way a round trip takes its time."""
        return self.local_clock.variance + _LEAST_VARIANCE

    @property
    def way_ns(self) -> float:
        """Of the round trips by which the local clock is known, what is not spent behind the slave."""
        return self._timing.least_ns + self.local_clock.excess_ns - 2 * self._half_behind_ns

    @property
    def has_none(self) -> bool:
        """Whether the new sample of the newest exchange has none, although one would be known."""
        return self._answers and self.local_clock.is_known and not self.instant_ns

    def took(self, latched: Latched, sent_ns: int, back_ns: int, fresh: bool, period_ns: float) -> None:
        """Take what was latched when a frame passed that was sent and back then.

        `fresh`: it brought a new sample. Exchanges come in the order in which they were sent.
        """
        self.instant_ns, self._is_next, self.is_doubtful = 0.0, False, False
        system, counted, change, counted_too = latched
        self._took_ns = back_ns - sent_ns
        self._answers = counted == counted_too == 1
        if not self._answers:
            return
        clock = self.local_clock
        before, local = self._local, clock.follow((system - self._offset) % _WRAP, back_ns)
        self._local = local
        if not fresh:
            return
        event = local - ((local - change + _HALF) % _WRAP - _HALF)
        self._moved += event != self._event
        self._event = event
        # Between these the process data passed: in the frame before, and in this one.
        oldest, newest = before + self._passing_ns - _SLACK_NS, local + self._passing_ns
        self._is_next = newest < event < local + self._reading_ns and event - period_ns > oldest
        fits = self._is_next or oldest < event <= newest + _SLACK_NS
        if fits and clock.is_known and clock.fits(sent_ns, back_ns):
            self.instant_ns = clock.time(event) - self._half_behind_ns - self._is_next * period_ns

    def learn(self, sent_ns: int, arrived_ns: int) -> None:
        """Learn from the exchange that `took` was about: sent, and begun to arrive, then."""
        if self._answers:
            self.local_clock.learn(sent_ns, arrived_ns)

    def date(
        self, expected_ns: float, period_ns: float, variance: float, sent_ns: int, back_ns: int
    ) -> float | None:
        """By how many periods `instant_ns` is later than expected; None if it does not date the sample.

        To be asked for each new sample while they are trusted. `variance` is that of `expected_ns`.
        """
        trust, late = self.trust, 0.0
        if self.instant_ns:
            late = (self.instant_ns - expected_ns) / period_ns
            off_ns = abs(late - round(late) if late > -0.5 else late) * period_ns
            doubt_ns = _OUTLIER * math.sqrt(variance + self.variance)
            self.is_doubtful = off_ns > doubt_ns or doubt_ns > period_ns / 2
            is_old = sent_ns - self.instant_ns > _OLDEST * period_ns
            # If the process data had passed when this sample's own event came, that is late: it lies.
            is_late = self._is_next and late < -0.5
            # A jump of the local clock by more than half a round trip is noticed by `fits`: a larger
            # difference means that the sensor's own sampling clock has changed.
            if not (is_old or is_late) and not doubt_ns < off_ns < self._took_ns / 2:
                trust.confirmed()
                return late
            trust.contradicted(self._is_in_time and not is_old)
        else:
            trust.contradicted(self._is_in_time)
        self.is_doubtful = True
        trust.reconsider(self._evidence, back_ns)
        self.are_trusted = trust.verdict is Verdict.TRUSTED
        return None

    def compare(self, difference_ns: float, variance: float, back_ns: int) -> float:
        """Try them on the new sample: by polling, with this variance, it came so much before `instant_ns`.

        To be called for each new sample while they are not trusted; the exchange was back at `back_ns`.
        Returns the variance of the differences once they are trusted from here on, else 0.
        """
        trust = self.trust
        if self._is_next:
            pass
        elif self.instant_ns:
            trust.compare(difference_ns)
        elif self._is_in_time and not (self._answers and not self.local_clock.is_known):
            trust.unfit()
        # Polling does not tell where on its way a round trip takes its time.
        asymmetry_ns = _ASYMMETRY * self._timing.least_ns
        variance += self.variance + asymmetry_ns * asymmetry_ns
        found = trust.end(self._evidence, variance, back_ns)
        self.are_trusted = trust.verdict is Verdict.TRUSTED
        return found

    @property
    def _evidence(self) -> Evidence:
        return Evidence(self.local_clock.restarts, self._moved)
