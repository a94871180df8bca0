"""The sampling clock of one sensor: which sample an exchange brought, and its instant.

The sensor samples freely; an exchange tells whether its process data changed since the one before, and a
slave controller with a distributed clock when it did. After a lost frame or a stall of the machine the
estimate is in holdover: it advances by the model, and its variance grows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from ethercat_server.sampling.association import (
    SILENT_PERIODS,
    Association,
    Expected,
    Read,
    associate_by_event,
    associate_by_polls,
    count_steps,
)
from ethercat_server.sampling.constants import (
    CERTAIN,
    CONTRADICTS,
    GAIN,
    LEARN_EVERY_NS,
    LOCKED,
    OVERDUE,
)
from ethercat_server.sampling.observation import Latched
from ethercat_server.sampling.phase import SensorPhase
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.schedule import Schedule
from ethercat_server.sampling.slave_clock import EventTimes


class SampleClock:
    """The sampling clock of one sensor, as observed through the exchanges.

    Call `observe` for every valid exchange, in the order in which they were sent, then `learn` if it says so;
    ask `next_poll_ns` when the next exchange is wanted. Exchanges are back when this program has them, and
    arrive when their first byte does.

    Attributes:
        events: event times of the slave controller; None if it latches none.
        phase: its phase is the next sample's instant less the outward part of the shortest round trip.
        locked: whether the phase is known well enough to follow it.
        instant_ns: estimated instant of the newest sample, from those before it.
        steps: number of the newest sample less that of the one handed out before it: more than 1 if some were
            lost, 0 to correct a loss that was counted and was none.
        uncertain: whether more may have been lost than `steps` says; the `steps` of later samples correct it.
        learns: whether `learn` must follow: a steady clock learns from some samples only, which are chosen
            before they arrive: otherwise the selection would bias the estimate.
        before_ns: an exchange that is back by more than this before the phase cannot bring a new sample.
    """

    __slots__ = (
        "_absent", "_begun", "_bias_ns", "_by_event", "_data_offset_ns", "_doubt_ns", "_doubtful", "_fresh",
        "_late_ns", "_moved_ns", "_number", "_outward_ns", "_overdue", "_read_at_ns", "_round_trip",
        "_schedule", "_seen_by_ns", "_sent_ns", "_skipped", "_skips", "_steady", "_sure_ns", "before_ns",
        "events", "instant_ns", "learns", "locked", "phase", "steps", "uncertain",
    )  # fmt: skip

    def __init__(
        self,
        period_ns: float,
        round_trip: RoundTrip,
        events: EventTimes | None = None,
        data_offset_ns: int = 0,
    ) -> None:
        """`period_ns` is the nominal sample period; `round_trip` that of the bus.

        The process data passes the slave `data_offset_ns` after the frame has arrived there.
        """
        self.events = events
        self.phase = SensorPhase(period_ns)
        self._data_offset_ns = data_offset_ns
        self._round_trip = round_trip
        self._schedule = Schedule(self.phase, round_trip)
        self.locked = False
        self.instant_ns = 0.0
        self.steps = 1
        self.uncertain = False
        self.learns = True
        self.before_ns = math.inf
        # The last exchange: when it was sent, and whether it brought a new sample.
        self._sent_ns, self._fresh = 0, False
        self._by_event = 0.0  # instant of the newest sample by its event, less the outward part; 0: unknown
        # When the last valid exchange was sent that was learned from or skipped.
        self._read_at_ns = 0
        self._moved_ns = round_trip.moved_ns
        self._bias_ns = 0.0  # by how much events are later than polls show, while polls are followed
        self._number = 1  # of the newest sample after the one before it, by the phase alone
        # Latest possible time of the PDI read in the exchange that brought the newest sample.
        self._seen_by_ns = 0.0
        self._absent = 0  # consecutive samples that were polled for and did not come
        # Whether any instant is known; the sample before was `uncertain`; the next one is overdue.
        self._begun = self._doubtful = self._overdue = False
        # Whether the next sample is certainly the expected one if its exchange is back less than `_sure_ns`
        # after its phase; its event is then within `_doubt_ns` of it, and it is overdue after `_late_ns`.
        self._steady = False
        self._sure_ns = self._doubt_ns = self._late_ns = self._outward_ns = 0.0
        # Samples that were not learned from since the last that was, and their limit.
        self._skipped = self._skips = 0
        self._derive()

    @property
    def period_ns(self) -> float:
        return self.phase.period_ns

    @property
    def uncertainty_ns(self) -> float:
        """Uncertainty of `instant_ns`: two standard deviations, and the asymmetry of the round trip.

        What a round trip usually takes beyond the shortest may be on either way, which cannot be observed. A
        sample that may be mistaken for another may be off by a period.
        """
        events, round_trip = self.events, self._round_trip
        if events is not None and events.are_trusted:
            variance, path_delay_ns = events.variance, events.path_delay_ns
        else:
            variance, path_delay_ns = self.phase.variance, round_trip.least_ns + round_trip.excess_ns
        return 2 * math.sqrt(variance) + path_delay_ns / 2 + (self.phase.period_ns if self.uncertain else 0.0)

    @property
    def by_events(self) -> bool:
        """Whether samples are dated by the slave controller."""
        return self.events is not None and self.events.are_trusted

    @property
    def _follows_events(self) -> bool:
        """Whether phase and period are learned from events.

        Where an early poll costs a sample, polls are timed by polls only: the asymmetry of a long round trip
        may put event times off by more than polls tolerate.
        """
        return self.by_events and not self._schedule.single

    @property
    def is_probing(self) -> bool:
        """Whether the next poll is to be early, and must not wait for another sensor's."""
        return self.locked and self._schedule.probing

    @property
    def one_by_one(self) -> bool:
        """Whether the clock is locked, and an exchange is back before the next one is due."""
        return self.locked and not self._schedule.single

    def next_poll_ns(self, sent_ns: int, unanswered: int, *, in_flight: bool) -> float:
        """See `Schedule`."""
        aim_ns = self.phase.phase_ns + self._schedule.aim_after_ns
        if self._steady and sent_ns < aim_ns and not in_flight:
            return aim_ns
        return self._schedule.next_poll_ns(
            sent_ns, unanswered, in_flight=in_flight, locked=self.locked, overdue=self._overdue
        )

    # -- what an exchange says

    def observe(self, sent_ns: int, back_ns: int, latched: Latched | None, *, fresh: bool) -> bool:
        """What a valid exchange brought, before learning from it; whether that is certainly the next sample.

        `latched` is what the slave controller has latched. If it brought a new sample (`fresh`) this sets
        `steps`, `uncertain` and `instant_ns`; it always sets `learns`.
        """
        self._sent_ns, self._fresh, events, phase = sent_ns, fresh, self.events, self.phase
        if latched is not None and events is not None:
            events.observe(latched, sent_ns, back_ns, fresh, phase.period_ns)
        if not fresh:
            self.learns = (
                self._skipped >= self._skips
                or sent_ns > phase.phase_ns + self._late_ns
                or self._moved_ns != self._round_trip.moved_ns
            )
            if not self.learns:
                self._schedule.count_early(adapts=False)
                self._read_at_ns = sent_ns
            return False
        if self._steady and back_ns < (phase_ns := phase.phase_ns) + self._sure_ns:
            if events is None or not events.are_trusted:
                instant_ns = max(phase_ns, self._read_at_ns) + self._outward_ns
                self._seen_by_ns = back_ns
            else:
                instant_ns = events.instant_ns
                self._by_event = instant_ns - self._outward_ns
            if -self._doubt_ns < instant_ns - self._outward_ns - phase_ns < self._doubt_ns:
                self.instant_ns = instant_ns if instant_ns < back_ns else back_ns
                if self._skipped < self._skips and self._moved_ns == self._round_trip.moved_ns:
                    self._skipped += 1
                    self.learns, self._read_at_ns = False, sent_ns
                    phase.phase_ns = phase_ns + phase.period_ns
                else:
                    self.learns = True
                return True
        self._skips, self.learns = 0, True
        self._associate(sent_ns, back_ns)
        return self.steps == 1 and not self.uncertain

    def _associate(self, sent_ns: int, back_ns: int) -> None:
        """Associate and date a new sample that may not be the expected one."""
        phase, round_trip = self.phase, self._round_trip
        phase_ns, period_ns, least_ns = phase.phase_ns, phase.period_ns, round_trip.least_ns
        outward_ns = least_ns / 2 + self._data_offset_ns
        unread_ns = back_ns - self._read_at_ns
        if not self._begun:
            self._number = 1
            # Only what came while the sensor was not polled can have been lost; before the first exchange
            # there was nothing to lose.
            self.steps = 1 + int(unread_ns // period_ns) if self._read_at_ns else 1
            self.uncertain = unread_ns >= period_ns
            self.instant_ns = min(back_ns, sent_ns + period_ns)
            return
        events, self._by_event, schedule = self.events, 0.0, self._schedule
        if events is not None and events.are_trusted:
            expected_ns = phase_ns + outward_ns + self._bias_ns
            late = events.date(expected_ns, period_ns, phase.variance, sent_ns, back_ns)
            if late is not None:
                if schedule.single:
                    self._bias_ns += GAIN * (late - round(late)) * period_ns
                else:
                    self._by_event = events.instant_ns - outward_ns
                found = associate_by_event(late, uncertain=events.is_doubtful)
                self._count(found, self._read_at_ns - self._seen_by_ns)
                self.instant_ns = min(events.instant_ns, back_ns)
                return
        excess_ns = max(0.0, back_ns - sent_ns - least_ns)
        unchanged_ns, self._seen_by_ns = self._read_at_ns - self._seen_by_ns, sent_ns + excess_ns
        doubt_ns = CERTAIN * math.sqrt(phase.variance)
        if not schedule.single:
            doubt_ns += least_ns / 4  # the outward part of a short round trip varies, too
        found = associate_by_polls(
            Expected(phase_ns, period_ns, doubt_ns, self._doubtful),
            Read(self._read_at_ns, sent_ns, back_ns, least_ns),
            has_events=events is not None,
            lost_track=events is not None and events.is_doubtful,
            was_silent=self._absent >= SILENT_PERIODS,
        )
        self._count(found, unchanged_ns)
        instant_ns = max(phase_ns + (self._number - 1) * period_ns, self._read_at_ns) + outward_ns
        # After a stall in the exchange its end says nothing of the sample's instant.
        self.instant_ns = min(instant_ns if self.locked else sent_ns + period_ns, back_ns)
        if events is None or not self.locked or events.are_trusted or self.uncertain:
            return
        if variance := events.compare(events.instant_ns - instant_ns, phase.variance, back_ns):
            self._bias_ns = events.trust.mean_ns
            if not schedule.single:
                phase.expect_noise(variance)

    def _count(self, found: Association, unchanged_ns: float) -> None:
        """Set `steps` and `uncertain`; see `count_steps`."""
        self.uncertain = found.uncertain
        self._number, self.steps = count_steps(
            found, is_doubtful=self._doubtful, absent=self._absent,
            unchanged_periods=unchanged_ns / self.phase.period_ns,
        )  # fmt: skip

    # -- learning

    def learn_events(self, sent_ns: int, arrived_ns: int, samples: int = 0) -> None:
        """Learn when events come to be from an exchange that began to arrive then; it is for `samples`."""
        if self.events is None:
            return
        moved_ns = self.events.local_clock.moved_ns
        self.events.learn(sent_ns, arrived_ns, samples)
        if self._follows_events:  # all events are earlier or later, and so are the samples
            self.phase.phase_ns += self.events.local_clock.moved_ns - moved_ns

    def learn(self, arrived_ns: int) -> None:
        """Learn from the exchange that was observed last, whose answer began to arrive at `arrived_ns`."""
        phase, schedule, sent_ns = self.phase, self._schedule, self._sent_ns
        moved_ns, self._moved_ns = self._moved_ns, self._round_trip.moved_ns
        phase.phase_ns += self._moved_ns - moved_ns
        self.learn_events(sent_ns, arrived_ns, 1 + self._skipped)
        if self._skipped:
            phase.hold_over(self._skipped)
            schedule.count_hit(self._skipped)
            self._skipped = 0
        read_ns, variance = self._round_trip.read_instant(sent_ns, arrived_ns)
        before_ns, self._read_at_ns = self._read_at_ns, sent_ns
        if not self._begun:
            # The instant of what the first exchange brings is unknown.
            if self._fresh and before_ns:
                self._begun = True
                phase.begin(max(before_ns, read_ns - phase.period_ns), read_ns)
        elif self._fresh:
            self._learn_sample(before_ns, read_ns, variance)
        else:
            self._learn_absence(sent_ns, read_ns, variance)
        self._derive()
        self._skips = round(LEARN_EVERY_NS / phase.period_ns) - 1 if self._steady and self._fresh else 0

    def _learn_sample(self, before_ns: int, read_ns: float, variance: float) -> None:
        """A sample was there at the read, with this variance, and not in the exchange sent before."""
        phase = self.phase
        if self._number != 1:
            phase.advance(self._number - 1)
        if self._by_event and self.events is not None:
            phase.learn_instant(self._by_event, self.events.variance)
        elif self.uncertain:
            pass  # it may be another sample's
        elif self.locked and not (before_ns > phase.phase_ns and self._is_late(before_ns, variance)):
            phase.learn_bit(read_ns, variance, 1)
        elif read_ns - before_ns < phase.period_ns:
            phase.learn_bracket(before_ns, read_ns, variance)
        phase.advance(1)
        if not self._by_event:
            self._schedule.count_polled_hit()
        self._schedule.count_hit()
        self._doubtful, self._absent, self._overdue = self.uncertain, 0, False

    def _learn_absence(self, sent_ns: int, read_ns: float, variance: float) -> None:
        """No sample was there at the read, with this variance, in the exchange that was sent then."""
        phase, follows_events = self.phase, self._follows_events
        doubt_ns = CONTRADICTS * math.sqrt(phase.variance)
        if (absent := int((sent_ns - phase.phase_ns - doubt_ns) // phase.period_ns)) > 0:
            phase.advance(absent)
            self._absent += absent
        self._overdue = read_ns > phase.phase_ns + OVERDUE * math.sqrt(phase.variance + variance)
        # In doubt it may have been seen already; late it may have been skipped: the next one shows.
        if self.locked and not (self._doubtful or self._is_late(read_ns, variance)):
            if not follows_events:
                phase.learn_bit(read_ns, variance, -1)
            if read_ns > phase.phase_ns - doubt_ns - self._schedule.margin_ns * (1 + follows_events):
                self._schedule.count_early(adapts=not follows_events)

    def _is_late(self, read_ns: float, variance: float) -> bool:
        """Whether a read came so late that the expected sample must have come, or was skipped."""
        phase = self.phase
        return read_ns > phase.phase_ns + CONTRADICTS * math.sqrt(phase.variance + variance)

    def _derive(self) -> None:
        """Derive from the phase what the next poll and the next exchange need."""
        round_trip, phase, events, schedule = self._round_trip, self.phase, self.events, self._schedule
        variance, period_ns, deviation_ns = phase.variance, phase.period_ns, math.sqrt(phase.variance)
        self.locked = self._begun and deviation_ns < LOCKED * period_ns
        schedule.derive(by_events=self.by_events)
        if self._bias_ns and not schedule.single:
            # Phase and period are learned from events again.
            phase.phase_ns += self._bias_ns
            self._bias_ns = 0.0
        self.before_ns = CERTAIN * deviation_ns if self.locked else math.inf
        self._outward_ns = round_trip.least_ns / 2 + self._data_offset_ns
        doubt_ns = self._doubt_ns = CERTAIN * math.sqrt(variance + (events.variance if events else 0.0))
        self._sure_ns = period_ns + round_trip.least_ns * 3 / 4 - doubt_ns
        self._late_ns = OVERDUE * math.sqrt(variance + round_trip.read_variance)
        # The new sample was the expected one, after another one that was.
        followed = self.steps == self._number == 1 and not (self.uncertain or self._doubtful or self._overdue)
        self._steady = (
            self.locked
            and followed
            and not (schedule.single or self._absent or 2 * doubt_ns > period_ns)
            and phase.is_steady
            and 8 * round_trip.excess_ns < period_ns
            and (events is None or events.trust.is_steady)
        )


def learn(
    round_trip: RoundTrip,
    clocks: Iterable[SampleClock],
    sent_ns: int,
    arrived_ns: int,
    back_ns: int,
    late_ns: float | None,
) -> None:
    """Have `round_trip`, then the `clocks` whose `learns` is set, learn from an exchange.

    The answer began to arrive, and was there, then; `late_ns` as in `RoundTrip.learn`.
    """
    round_trip.learn(sent_ns, arrived_ns, back_ns, late_ns)
    for clock in clocks:
        clock.learn(arrived_ns)


def learn_short_exchange(
    round_trip: RoundTrip, clocks: Iterable[SampleClock], sent_ns: int, arrived_ns: int
) -> None:
    """Learn a slave controller's local time, and nothing else, from an exchange that took little time."""
    round_trip.learn_shortest(sent_ns, arrived_ns)
    for clock in clocks:
        clock.learn_events(sent_ns, arrived_ns)
