"""One sensor's stream: which exchanges brought a new sample, and the DATA frame for it.

A frame exists for every new sample. While the sensor is silent there is one REPEATED (or INVALID)
frame for each sample period that passes, so that its silence is visible; the polls in between samples, which
find the same data again only because the bus is read more often than the sensor samples, make none. An answer
that arrives after that of a later exchange is ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from bota_ethercat.distribution import RecentDistribution
from bota_ethercat.framing import DataFlag, data_encoder
from bota_ethercat.pdo import LAYOUTS
from ethercat_server.acquisition.drift import Drift
from ethercat_server.acquisition.health import SampleHealth
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import SLACK_NS, SYSTEM_CLOCK, Clock, StampClocks
from ethercat_server.ethercat.exchange import DUPLICATE, Exchange
from ethercat_server.ethercat.wire import BYTE_NS
from ethercat_server.sampling.association import SILENT_PERIODS
from ethercat_server.sampling.observation import DistributedClock, Latched
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock
from ethercat_server.sampling.slave_clock import EventTimes
from ethercat_server.sampling.trace import NOTHING, Note, RecordKind
from ethercat_server.sampling.trust import TrustState
from ethercat_server.sensor.sensor import Sensor

DISCARDED_AT_START: Final = 3  # Bota's own driver discards the first three frames after entering OP

# A DATA frame, the number of its sensor (terminals are numbered after all sensors), its flags, and when the
# exchange was back that brought the newest sample.
OutgoingFrame = tuple[bytes, int, int, int]

REPEATED, INVALID, GAP = (int(flag) for flag in (DataFlag.REPEATED, DataFlag.INVALID, DataFlag.GAP))


class SensorStream:
    """Numbers and stamps the frames of one sensor, and sets their flags."""

    def __init__(
        self,
        sensor: Sensor,
        round_trip: RoundTrip,
        clock: Clock = SYSTEM_CLOCK,
        latching: DistributedClock | None = None,
        stamps: StampClocks | None = None,
        data_offset_ns: int = 0,
        data_size: int = min(LAYOUTS),
    ) -> None:
        """`latching` is the clock of the slave controller, if that latches when samples come to be.

        Its process data, of `data_size` bytes, passes the slave `data_offset_ns` after the frame has arrived
        there.
        """
        self.number = sensor.number
        self._raw_ns, self._monotonic_ns = clock.raw_ns, clock.monotonic_ns
        self.stamps = stamps or StampClocks(clock)
        self._round_trip = round_trip
        self._data_offset_ns = data_offset_ns
        self.clock = self._new_clock(sensor.period_ns, latching)
        self.process_data = b""  # the newest valid process data
        self._handed_out = b""  # what the last frame carried: a REPEATED or INVALID one carries it again
        self.sequence = 0
        self.repeated = 0
        self.invalid_frames = 0
        self.lost_samples = 0
        self.recoveries = 0
        # From the estimated instant of a sample to its hand-out, while locked.
        self.age = RecentDistribution()
        self.drift = Drift(sensor, clock)
        self.health = SampleHealth(sensor.number, self.drift.add)
        # Process data and age of the samples handed out since `count`; None while the clock is not locked.
        self._counted: list[tuple[bytes, float | None]] = []
        self._encode = data_encoder(data_size)
        self._discard = DISCARDED_AT_START
        self._gap = 0  # number of new samples to come that have GAP
        self._silent = False  # whether REPEATED or INVALID frames were made since the newest sample
        self.exchange = DUPLICATE  # the last one that was valid for this sensor
        self._newest_ns = 0  # when the exchange was back that brought the newest sample
        # The working counter of an exchange since then that was not valid; 0 for none.
        self._invalid_wkc = 0
        self._instant_ns = 0  # of the newest sample, CLOCK_MONOTONIC
        self.notes: list[Note] = []  # see `Tracing`
        self.on_change: Callable[[], None] = lambda: None  # the clock is another one, or begins anew
        self.model, self.nominal_hz = sensor.identity.name, 1e9 / sensor.period_ns
        self.silent_at_ns = 0.0  # it is silent from then on

    def _new_clock(self, period_ns: float, latching: DistributedClock | None) -> SampleClock:
        events = latching and EventTimes(latching, self._round_trip, self._data_offset_ns)
        return SampleClock(period_ns, self._round_trip, events, self._data_offset_ns)

    @property
    def fresh(self) -> int:
        """Frames that brought a new sample."""
        return self.sequence - self.repeated - self.invalid_frames

    def make_frame(
        self, data: bytes, exchange: Exchange, latched: Latched | None = None
    ) -> OutgoingFrame | None:
        """The frame that a valid exchange gives, no older than the one before; None if it gives none.

        `latched` is what the slave controller has latched. If `clock.learns` then, `clock.learn` must follow.
        """
        sent_ns, back_ns, _, wkc, _ = exchange
        clock, stamps, self.exchange = self.clock, self.stamps, exchange
        fresh = data != self.process_data
        is_next = clock.observe(sent_ns, back_ns, latched, fresh=fresh)
        self.notes.append((exchange, latched or NOTHING, self.number, fresh))
        if not fresh:
            return self.make_silent(back_ns)
        self.process_data, self.silent_at_ns = data, back_ns + SILENT_PERIODS * clock.phase.period_ns
        if self._discard:
            self._discard -= 1
            return None
        flags = 0 if is_next and not (self._silent or self._gap) else self._count_lost()
        if not -SLACK_NS < self._monotonic_ns() - self._raw_ns() * stamps.rate - stamps.base_ns < SLACK_NS:
            stamps.follow()
        if (at_ns := int(clock.instant_ns * stamps.rate + stamps.base_ns)) <= self._instant_ns:
            at_ns = self._instant_ns + 1  # the one before was dated too late
        self._instant_ns, self._newest_ns, self._handed_out = at_ns, back_ns, data
        self._counted.append((data, back_ns - clock.instant_ns if clock.locked else None))
        frame = self._encode(self.sequence, at_ns + stamps.realtime_ns, at_ns, self.number, flags, wkc, data)
        self.sequence += 1
        return frame, self.number, flags, back_ns

    def make_invalid(self, exchange: Exchange) -> OutgoingFrame | None:
        """The frame for an exchange that brought nothing of this sensor, as `make_silent`."""
        self.notes.append((exchange, NOTHING, self.number, RecordKind.INVALID))
        self._invalid_wkc = exchange.wkc
        return self.make_silent(exchange.back_ns)

    def make_silent(self, now_ns: int) -> OutgoingFrame | None:
        """The frame that shows the sensor's silence, one a period; None if there is none to show."""
        if now_ns < self.silent_at_ns or not self.process_data:
            return None
        self._silent = True
        self._handed_out = self._handed_out or self.process_data
        period_ns = self.clock.period_ns
        # The next slot is counted from this one, but a stall makes one frame, not a burst.
        self.silent_at_ns = max(self.silent_at_ns + period_ns, float(now_ns))
        # INVALID means that no valid exchange was back for two periods: a single lost frame does not suffice.
        if now_ns - self.exchange.back_ns < max(2 * period_ns, self._round_trip.patience_ns):
            self._discard = 0  # a sensor that is stuck from the start has to be visible, too
            self.repeated += 1
            flags, wkc = REPEATED, self.exchange.wkc
        else:
            self.invalid_frames += 1
            flags, wkc = INVALID, self._invalid_wkc
            self._invalid_wkc = 0
        stamp_ns, sequence = self.stamps.monotonic_ns(now_ns), self.sequence
        self.sequence += 1
        realtime_ns = stamp_ns + self.stamps.realtime_ns
        made = self._encode(sequence, realtime_ns, stamp_ns, self.number, flags, wkc, self._handed_out)
        return made, self.number, flags, self._newest_ns

    def _count_lost(self) -> int:
        """The flags of a new sample that may not be the next one after that before it."""
        lost = self.clock.steps - 1 if self.sequence else 0
        # -1 corrects the count after a stall, if the sample came late.
        self.lost_samples = max(0, self.lost_samples + lost)
        flags = GAP if lost > 0 or self.clock.uncertain or self._gap else 0
        self._gap = max(0, self._gap - 1)
        # Without an event, the slave may have held back the sample that ends a silence, or the one after it:
        # one may be missing after either.
        if self._silent and ((events := self.clock.events) is None or events.lacks_event):
            self._gap = 2
        self._silent = False
        return flags

    def count(self) -> None:
        """Look at what was handed out since the last time; to be called now and then."""
        if self._counted:
            samples, ages = zip(*self._counted, strict=True)
            self._counted.clear()
            self.health.count(samples)
            self.age.extend([age for age in ages if age is not None])

    def check(self) -> None:
        """To be called once a second: log what the samples show of the sensor."""
        self.count()
        self.health.check(self.fresh, self.repeated, self.clock)
        self.drift.each_second()
        events = self.clock.events
        if events is not None and events.trust.state is TrustState.ABSENT:
            self.clock.events = None
            self.on_change()

    def retry_events(self, latching: DistributedClock) -> None:
        """Try refused event times again; the slave controller's clock may be another one."""
        if self.clock.events is not None:
            self.clock.events.retry(latching)
            self.on_change()

    def recover(
        self, period_ns: float | None, *, lost: bool = True, latching: DistributedClock | None = None
    ) -> None:
        """The sensor is back after it was out; `period_ns` if it entered OP anew, None if it never left."""
        self.recoveries += lost
        if period_ns is not None:
            before, self.clock = self.clock.events, self._new_clock(period_ns, latching)
            if before is not None and self.clock.events is not None:
                self.clock.events.trust.was_trusted = before.trust.was_trusted
            self.drift.begin("return")
            self._discard = DISCARDED_AT_START
            self._gap = 1
            self.silent_at_ns = self._raw_ns() + SILENT_PERIODS * period_ns
            self.on_change()

    def status(self) -> dict[str, Any]:
        """The sensor's part of the `status` reply, except for the age."""
        clock = self.clock
        return {
            "sensor": self.number,
            "fresh": self.fresh,
            "repeated": self.repeated,
            "invalid": self.invalid_frames,
            "lost_samples": self.lost_samples,
            "not_finite": self.health.not_finite,
            "recoveries": self.recoveries,
            "clock": {
                "mode": "locked" if clock.locked else "oversampling",
                "stamps": "hardware" if clock.by_events else "polling",
                "period_us": clock.period_ns / 1000,
                "offset_ppm": round((1 / (1 + clock.phase.period_error) - 1) * 1e6, 1),
                "uncertainty_us": round(clock.uncertainty_ns / 1000, 1) if clock.locked else None,
            },
            **self.drift.as_json(),
        }


def make_streams(bus: Bus, sensors: Sequence[Sensor], round_trip: RoundTrip) -> list[SensorStream]:
    """Those of the sensors on a bus in OP."""
    stamps = StampClocks(bus.clock)
    data = {at.number: at for inputs in bus.process_data.inputs for at in inputs}
    streams = []
    for number, sensor in enumerate(sensors):
        latching, start, end = bus.finish(bus.read_clock(number)), data[number].start, data[number].end
        streams.append(
            SensorStream(sensor, round_trip, bus.clock, latching, stamps, start * BYTE_NS, end - start)
        )
    return streams
