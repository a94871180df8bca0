"""The acquisition loop: exchange, hand out, learn, serve the sockets until the next exchange is due.

Each sensor has a clock of its own, an exchange reads all of them: `Cycle._due_ns` merges their polls. Answers
are handed out whenever they arrive, so that a slow network card has several exchanges on their way. One
thread does everything. docs/architecture.md draws the way of a sample; `scripts/benchmark --path` counts what
it takes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle
from math import inf
from typing import Any, Final, Protocol

from bota_ethercat.distribution import SLOT_NS, RecentDistribution
from ethercat_server.acquisition.acyclic import Acyclic
from ethercat_server.acquisition.health import RoundTripHealth
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.stream import OutgoingFrame, SensorStream
from ethercat_server.acquisition.tracing import Tracing
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.exchange import DUPLICATE, LATCHED, Exchange
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock, learn, learn_short_exchange
from ethercat_server.sampling.trace import RecordKind, learn_note
from ethercat_server.sensor.sensor import Sensor, SensorState

# Longest interval between two servings of the sockets, even if every deadline has passed.
_SERVE_EVERY_NS: Final = 10_000_000
_SERVE_IN_FLIGHT_NS: Final = 2_000_000  # the same while an exchange is in flight: then serving does not wait
_CHORES_EVERY_NS: Final = 20_000_000  # interval between chores, such as whether CLOCK_REALTIME was set
_RECOVERY_STEP_NS: Final = 500_000  # time between two exchanges while all sensors are lost
# Interval between summaries of the distributions, which take some 100 µs each.
_SUMMARY_NS: Final = 200_000_000
_COST_GAIN: Final = 1 / 64
_FIRST_COST_NS: Final = 50_000.0
_BUDGET: Final = 1 / 4  # fraction of the time that exchanges may take
_LARGEST_WAIT: Final = 0.3  # longest time that a poll waits for another, in shortest sample periods
# Read for every sample: as an attribute of its Enum it takes ten times as long.
_STREAMING: Final = SensorState.STREAMING
# Longest time by which polls are brought forward because this machine wakes late.
_LONGEST_LEAD_NS: Final = 200_000.0


class Outlet(Protocol):
    """Where the samples go: the server's `Hub`."""

    def publish(self, made: Sequence[OutgoingFrame], now_ns: int) -> None:
        """Take the DATA frames that an exchange made, one for a sensor; `now_ns` is when it was back."""

    def serve(self, until_ns: int) -> int:
        """Serve the clients, or wait, until CLOCK_MONOTONIC_RAW is `until_ns`; returns the time."""


class Watchdog(Protocol):
    """systemd's watchdog: it has to be fed as long as the loop runs."""

    @property
    def feed_every_ns(self) -> int:
        """The longest time between two calls of `feed`."""

    def feed(self) -> None:
        """Tell it that the loop runs."""


class Cycle:
    """Reads the sensors and passes their samples to the outlet until `stop`."""

    def __init__(
        self,
        bus: Bus,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
        round_trip: RoundTrip,
        hub: Outlet,
        acyclic: Acyclic,
        recovery: Recovery,
        jobs: Jobs,
        watchdog: Watchdog,
    ) -> None:
        self.stopping = False
        self.every_second: Callable[[], None] = lambda: None  # called once a second
        self._acyclic, self._jobs = acyclic, jobs
        self._watchdog = watchdog
        self._bus, self._process_data = bus, bus.process_data
        self._backend, self._raw_ns = bus.backend, bus.clock.raw_ns
        self._sensors = sensors
        self._streams = streams
        self._hub, self._stamps = hub, streams[0].stamps
        self._recovery = recovery
        self._missed_deadlines = self._missed_until_ns = 0
        self._round_trip = round_trip
        self._cost_ns = _FIRST_COST_NS  # what an exchange and its samples keep the loop busy
        self._wire_ns, self._most_wkc = bus.process_data.wire_ns, bus.process_data.most_wkc
        self.tracing = Tracing(round_trip, streams)
        self._round_trip_health = RoundTripHealth(round_trip, bus)
        # By frame of the exchange: where it carries what of which sensor.
        self._carried = [
            [
                (at.start, at.end, at.unfilled, at.latched, sensors[at.number], streams[at.number])
                for at in each
            ]
            for each in bus.process_data.inputs
        ]
        # When the last exchange was sent; whether it is in flight; how many were sent since the last answer,
        # and when the first of those was, if there are several.
        self._sent_ns = self._unanswered_since_ns = bus.clock.raw_ns()
        self._in_flight, self._unanswered = False, 0
        # Wake-up lateness of the first sleep since the clocks learned; None before it.
        self._woke_late_ns: float | None = None
        self._short_ns = 0.0  # an exchange that is back sooner is a short one, from which local clocks learn
        self._wake = RecentDistribution()
        self._exchange = RecentDistribution()
        self._everyone = [self._wake, self._exchange, *(stream.age for stream in streams)]
        self._in_turn = cycle(self._everyone)
        self._started_ns = bus.clock.raw_ns()
        self._summarize_at_ns = 0
        self._chores_at_ns = self._roll_at_ns = 0
        self._slept = False  # whether the loop had slept until the due exchange when `stop` ended it
        self._summaries: list[tuple[dict[str, float], dict[str, float]]] = []
        self._plan()

    def stop(self) -> None:
        """End `run` before the next exchange."""
        self.stopping = True

    def run(self) -> None:
        """Run the loop until `stop`."""
        hub, acyclic, recovery = self._hub, self._acyclic, self._recovery
        raw_ns, serve_by, slept = self._raw_ns, 0, self._slept
        self._feed_at_ns = 0
        while True:
            due, now = self._due_ns(), raw_ns()
            if now >= acyclic.due_ns:
                self._jobs.check()
                # While working counters are too low, or all sensors are lost, no poll must be in time.
                acyclic.run(due if recovery.polled and not recovery.incomplete else inf, now)
                due, now = self._due_ns(), raw_ns()
            in_flight = self._in_flight or acyclic.awaiting is not None
            slept = slept or (due > now and not in_flight)
            if slept or now > serve_by:
                now = hub.serve(now if in_flight else due)
                serve_by = now + (_SERVE_IN_FLIGHT_NS if in_flight else _SERVE_EVERY_NS)
            if self.stopping:
                break
            self._step(now, due, (now if in_flight else due) + _SERVE_EVERY_NS, slept=slept)
            now, slept = raw_ns(), False
            if now >= self._chores_at_ns:
                self._do_chores(now)
        self._slept = slept

    def _due_ns(self) -> int:
        """When the next exchange is due.

        Polls that lie close together are merged: the earlier one, unless it probes the phase, waits for the
        later, by no more than the time that four exchanges cost this machine, as measured. So three quarters
        of its time are left.
        """
        streams, sent_ns, unanswered = self._recovery.polled, self._sent_ns, self._unanswered
        if len(streams) == 1:
            poll_ns = streams[0].clock.next_poll_ns(sent_ns, unanswered, in_flight=self._in_flight)
        elif streams:
            wanted = [
                stream.clock.next_poll_ns(sent_ns, unanswered, in_flight=self._in_flight)
                for stream in streams
            ]
            early = (poll for poll, each in zip(wanted, streams, strict=True) if each.clock.is_probing)
            latest_ns = min(min(wanted) + self._spacing_ns, *early, inf)
            poll_ns = max([each for each in wanted if each <= latest_ns])
        else:
            return sent_ns + _RECOVERY_STEP_NS
        due_ns = poll_ns - min(self._round_trip.late_ns, _LONGEST_LEAD_NS)
        return int(max(due_ns, sent_ns + self._spacing_ns, self._process_data.blocked_until_ns))

    def _plan(self) -> None:
        """Derive from the sensors' rates, which change, how exchanges follow each other; once a second."""
        self._shortest_ns = min(stream.clock.period_ns for stream in self._streams)
        self._spacing_ns = min(self._cost_ns / _BUDGET, _LARGEST_WAIT * self._shortest_ns)
        events = [stream.clock.events for stream in self._streams]
        self._local_clocks = [each.local_clock for each in events if each is not None]
        # Whether the answer to an exchange is usually back before the next one is due.
        self._one_by_one = all(stream.clock.one_by_one for stream in self._streams)

    def _step(self, now: int, due: int, until_ns: int, *, slept: bool) -> None:
        """Hand out what arrives until the next exchange is `due`, then send it; return by `until_ns`.

        After it is sent its answer is awaited, until yet another one is due. `slept`: the loop has slept
        until it was due.
        """
        if now < due or self._process_data.in_flight or until_ns <= now:
            if self._unanswered > 1:
                self._recovery.check_silence(now - self._unanswered_since_ns, now)
            wait = min(due, until_ns) - now
            is_answered = self._receive(wait, now)
            if is_answered or (now := self._raw_ns()) < due:
                return
            slept = slept or wait > 0
        if self._unanswered or now - due > self._shortest_ns:
            self._send_late(now, due, slept=slept)
        self._sent_ns = sent = self._process_data.send()
        self._in_flight, self._unanswered = True, self._unanswered + 1
        if slept:
            self._wake.record(sent - due)
            if self._woke_late_ns is None:
                self._woke_late_ns = sent - due
        most = self._round_trip.patience_ns if self._one_by_one else self._due_ns() - self._raw_ns()
        if (wait := min(int(most), until_ns - now)) > 0:
            self._receive(wait, sent)

    def _send_late(self, now: int, due: int, *, slept: bool) -> None:
        """An exchange is about to be sent that is overdue, or while the one before is unanswered."""
        if now - due > self._shortest_ns:
            self._count_missed(due, now)
            if slept:  # otherwise a late answer is why the exchange is overdue
                self._recovery.causes.see_stall(now - due, now)
        if self._unanswered:
            if self._unanswered == 1:
                self._unanswered_since_ns = self._sent_ns
            self._show_silence(now)

    def _receive(self, wait: int, since_ns: int) -> bool:
        """Wait for a frame, `wait` ns from `since_ns` at most; whether it was an exchange's answer.

        That is handed out.
        """
        frame, back = self._backend.receive(wait * 1e-9 if wait > 0 else 0.0), self._raw_ns()
        while frame is not None and (exchange := self._process_data.match(frame, back)) is DUPLICATE:
            # Drain duplicates of earlier answers, which would delay this one.
            if back > self._sent_ns + _SERVE_EVERY_NS:
                return False
            frame, back = self._backend.receive(0.0), self._raw_ns()
        if frame is None or exchange is None:
            if frame is not None:
                self._recovery.causes.other_master.see(frame, back)
                self._acyclic.receive(frame)
            return False
        self._hand_out(exchange, since_ns)
        return True

    def _hand_out(self, exchange: Exchange, since_ns: int) -> None:
        """Hand out what an exchange brought, which was awaited since then; then learn from it."""
        sent, back, frame, wkc, which = exchange
        new, learners = list[OutgoingFrame](), list[SampleClock]()
        complete = self._recovery.alive_wkc[which] <= wkc <= self._most_wkc[which]
        for start, end, unfilled, at, sensor, stream in self._carried[which]:
            if back < stream.clock.phase.phase_ns - stream.clock.before_ns or sent < stream.exchange.sent_ns:
                continue  # the poll was for another sensor, or was overtaken
            data = frame[start:end]
            # The working counter does not tell sensors apart: one that is out may be counted for another.
            if not complete or sensor.state is not _STREAMING or data == unfilled:
                made = stream.make_invalid(exchange)
            else:
                made = stream.make_frame(data, exchange, LATCHED.unpack_from(frame, at) if at else None)
                if stream.clock.learns:
                    learners.append(stream.clock)
            if made is not None:
                new.append(made)
        if new:
            self._hub.publish(new, back)
        self._in_flight, self._unanswered = sent < self._sent_ns, 0
        self._exchange.record(back - sent)
        if not complete or self._recovery.incomplete:
            self._recovery.check_answer(complete=complete)
        if learners or not self._short_ns < back - sent < self._round_trip.usual_ns + self._shortest_ns:
            self._learn(exchange, learners, since_ns)

    def _show_silence(self, now: int) -> None:
        """Hand out frames of the sensors that have been silent for too long while no answer comes."""
        if new := [made for stream in self._streams if (made := stream.make_silent(now))]:
            self._hub.publish(new, now)

    def _count_missed(self, due_ns: float, now_ns: int) -> None:
        """Count as missed the sample periods from `due_ns` until now that are not counted yet."""
        missed = max(0, int((now_ns - max(due_ns, self._missed_until_ns)) // self._shortest_ns))
        self._missed_deadlines += missed
        self._missed_until_ns = now_ns

    def _learn(self, exchange: Exchange, learners: Sequence[SampleClock], since_ns: int) -> None:
        """Learn from an exchange that `learners` need, was a short one, or was held up."""
        sent, back, _, _, which = exchange
        round_trip = self._round_trip
        arrived = self._bus.backend.arrived_ns()
        if not sent < arrived < back:  # the kernel does not say, or CLOCK_REALTIME was set
            arrived = back
        arrived = back - int((back - arrived) / self._stamps.rate)  # by CLOCK_REALTIME
        if back - sent - round_trip.usual_ns > self._shortest_ns:  # it was held up
            self._count_missed(sent + round_trip.usual_ns, back)
            # By this computer, if the answer had arrived, and the loop was waiting for it.
            self._recovery.causes.see_stall(back - max(arrived, since_ns), back)
        arrived = max(sent, arrived - self._wire_ns[which])
        if learners:
            self.tracing.notes.append(learn_note(exchange, arrived, RecordKind.LEARNED, self._woke_late_ns))
            learn(round_trip, learners, sent, arrived, back, self._woke_late_ns)
            self._woke_late_ns = None
            self._cost_ns += _COST_GAIN * (self._bus.clock.raw_ns() - back - self._cost_ns)
        else:
            self.tracing.notes.append(learn_note(exchange, arrived))
            clocks = [row[-1].clock for row in self._carried[which] if row[-1].exchange is exchange]
            learn_short_exchange(round_trip, clocks, sent, arrived)
        if self._local_clocks:
            self._short_ns = max([each.short_ns for each in self._local_clocks])

    def _do_chores(self, now: int) -> None:
        """Housekeeping that is not done for every exchange, a little at a time."""
        self._chores_at_ns = now + _CHORES_EVERY_NS
        self._stamps.follow_realtime()
        self.tracing.pack()
        next(self._in_turn).count()
        for stream in self._streams:
            stream.count()
        if now >= self._feed_at_ns:
            self._feed_at_ns = now + self._watchdog.feed_every_ns
            self._watchdog.feed()
        if now >= self._roll_at_ns:
            self._roll_at_ns = now + SLOT_NS
            self._each_second()

    def _each_second(self) -> None:
        for distribution in self._everyone:
            distribution.roll()
        self._plan()
        self._round_trip_health.check()
        self._recovery.check()
        self.tracing.each_second()
        for stream in self._streams:
            stream.check()
            if stream.clock.events is None:
                self._bus.process_data.read_latched(stream.number, reads=False)
        self.every_second()

    def trace(self, offset: int) -> dict[str, Any]:
        """See `Tracing.part`."""
        return self.tracing.part(offset)

    def status(self) -> dict[str, Any]:
        """The cycle's part of the `status` reply."""
        now_ns = self._bus.clock.raw_ns()
        if now_ns >= self._summarize_at_ns:
            self._summarize_at_ns = now_ns + _SUMMARY_NS
            for stream in self._streams:
                stream.count()
            self._summaries = [distribution.summaries_us() for distribution in self._everyone]
        (wake, recent_wake), (exchange, recent_exchange), *ages = self._summaries
        return {
            "cycles": self._bus.process_data.sent,
            "round_trip": self._round_trip.as_json(),
            "missed_deadlines": self._missed_deadlines,
            "lost_frames": self._bus.process_data.lost,
            "duplicate_frames": self._bus.process_data.duplicates,
            "wake_us": wake,
            "exchange_us": exchange,
            "last_10s": {
                "wake_us": recent_wake,
                "exchange_us": recent_exchange,
                "age_us": [recent for _, recent in ages],
            },
            "sensors": [
                {
                    **stream.status(),
                    **self._bus.emergencies.status(stream.number),
                    "settling": sensor.settling,
                    "age_us": age,
                }
                for sensor, stream, (age, _) in zip(self._sensors, self._streams, ages, strict=True)
            ],
            "uptime_s": round((now_ns - self._started_ns) * 1e-9, 3),
        }
