"""When a sensor's samples came to be, by what its slave controller latches.

A controller with distributed clocks keeps its local time of the moment when the sensor's processor had
written a sample (PDI buffer change event). The frame that reads the sample reads that, too. Which sample an
event belongs to is certain: it came after the frame before, which did not bring the sample, and before this.
"""

from __future__ import annotations

from typing import Final

from ethercat_server.acquisition.hardware.local_clock import LocalClock
from ethercat_server.acquisition.hardware.trust import Trust, Verdict
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.ethercat.exchange.distributed_clock import DistributedClock, Latched

_WRAP: Final = 1 << 32
_HALF: Final = 1 << 31
_FRAME_NS: Final = 150_000
"""An event may come while the frame passes; the longest one takes less."""


class EventTimes:
    """Of one sensor. `took` follows every exchange; after one that brought a new sample, `judge`."""

    __slots__ = (
        "_event",
        "_half_behind_ns",
        "_local",
        "_offset",
        "fits",
        "instant_ns",
        "local_clock",
        "moved",
        "trust",
    )

    def __init__(self, clock: DistributedClock, timing: ExchangeTiming) -> None:
        """`clock` is the slave controller's; `timing` that of the bus."""
        self.local_clock = LocalClock(timing)
        self.trust = Trust()
        self.instant_ns = 0.0
        """CLOCK_MONOTONIC of the new sample of the newest exchange; 0 if its event does not say."""
        self.fits = False
        """Whether that event can be this sample's."""
        self.moved = 0
        """Number of samples with an event of their own."""
        self._offset = clock.offset
        self._half_behind_ns = clock.behind_ns / 2
        self._local = self._event = 0
        """Local times of the newest exchange and of the newest sample's event."""

    @property
    def variance(self) -> float:
        """Of `instant_ns` about the instants of a clock that runs evenly, in ns²."""
        return self.trust.spread + self.local_clock.variance

    @property
    def restarts(self) -> int:
        """How often the local clock was found to be another."""
        return self.local_clock.restarts

    @property
    def are_trusted(self) -> bool:
        """Whether samples are dated by them."""
        return self.trust.verdict is Verdict.TRUSTED

    def took(self, latched: Latched, sent_ns: int, back_ns: int, fresh: bool) -> None:
        """Take what was latched when a frame passed that was sent and back then.

        `fresh`: it brought a new sample. Exchanges come in the order in which they were sent.
        """
        self.instant_ns, self.fits = 0.0, False
        system, counted, _, change, counted_too = latched
        if counted != 1 or counted_too != 1:
            return
        clock = self.local_clock
        clock.saw((system - self._offset) % _WRAP, sent_ns, back_ns)
        before, self._local = self._local, local = self._local, clock.local
        if not fresh:
            return
        event = local - ((local - change + _HALF) % _WRAP - _HALF)
        self.moved += event != self._event
        self._event = event
        self.fits = before < event < local + _FRAME_NS
        # One that came while the frame passed may be this sample's or the next one's.
        if self.fits and event <= local and clock.is_known and clock.fits(sent_ns, back_ns):
            self.instant_ns = clock.time(event) - self._half_behind_ns

    def judge(self, difference_ns: float, variance: float, back_ns: int) -> bool:
        """Whether the new sample is dated by `instant_ns`.

        That is so much later than the estimate by polling expects, with this variance; the exchange was back
        at `back_ns`.
        """
        trust = self.trust
        if trust.verdict is Verdict.TRUSTED:
            return trust.keeps(self, difference_ns, variance + self.local_clock.variance, back_ns)
        if trust.verdict is Verdict.TRIAL:
            trust.tries(self, difference_ns, variance + self.local_clock.variance, back_ns)
        return False
