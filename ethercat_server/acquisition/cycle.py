"""The acquisition loop: exchange, hand out, serve the sockets until the next exchange is due.

The schedule says when that is, as an absolute time on CLOCK_MONOTONIC; answers are handed out whenever they
arrive, so that a slow network card has several exchanges on their way. One thread does everything, and
`_step`, `_receive`, `_hand_out` and `_learn` are all of the hot path outside `SensorStream.take`, its `learn`
and `Connection.offer`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from ethercat_server.acquisition.health.round_trip import RoundTripHealth
from ethercat_server.acquisition.histogram import SLOT_NS, RecentDistribution
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.stream import Made, SensorStream
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.timing.schedule import Schedule
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.exchange.distributed_clock import LATCHED
from ethercat_server.sensor.sensor import Sensor, SensorState

_SERVE_EVERY_NS: Final = 10_000_000
"""Sockets are served this often even if every deadline has passed."""
_SERVE_IN_FLIGHT_NS: Final = 2_000_000
"""Sockets are served this often, without waiting, while an exchange is on its way."""
_REALTIME_EVERY_NS: Final = 20_000_000
"""Interval between looks at whether CLOCK_REALTIME was set."""
_RECOVERY_STEP_NS: Final = 500_000
"""Time between two exchanges while all sensors are lost."""
_SUMMARY_NS: Final = 200_000_000
"""Interval between summaries of the distributions, which take some 100 µs each."""


class Outlet(Protocol):
    """Where the samples go: the server's `Hub`, or a tool that wants them in its own process."""

    def publish(self, made: Sequence[Made], now_ns: int) -> None:
        """Take the DATA frames that an exchange made, one for a sensor; `now_ns` is when it was back."""
        ...

    def serve(self, until_ns: int) -> None:
        """Do what else there is to do until CLOCK_MONOTONIC is `until_ns`."""
        ...


class Watchdog(Protocol):
    """Has to be fed as long as the loop runs."""

    @property
    def feed_every_ns(self) -> int:
        """The longest time between two calls of `feed`."""
        ...

    def feed(self) -> None:
        """The loop runs."""
        ...


class Cycle:
    """Reads the sensors and passes their samples to the outlet until `stop`."""

    def __init__(
        self,
        bus: Bus,
        sensors: Sequence[Sensor],
        streams: Sequence[SensorStream],
        timing: ExchangeTiming,
        hub: Outlet,
        recovery: Recovery,
        jobs: Jobs,
        watchdog: Watchdog,
    ) -> None:
        self.stopping = False
        self.every_second: Callable[[], None] = lambda: None
        """Called once a second."""
        self._jobs = jobs
        self._watchdog = watchdog
        self._bus = bus
        self._sensors = sensors
        self._streams = streams
        self._hub = hub
        self._recovery = recovery
        self._cycles = 0
        self._missed_deadlines = 0
        self._timing = timing
        self._schedule = Schedule(streams, timing)
        self._wire_ns, self._most_wkc = bus.process_data.wire_ns, bus.process_data.most_wkc
        timing.wire_ns = max(self._wire_ns)
        self._round_trip = RoundTripHealth(timing, bus.ifname)
        carried = bus.process_data.inputs
        self._carried = [[(*at, sensors[at.number], streams[at.number]) for at in each] for each in carried]
        """By frame of the exchange: where it carries what of which sensor."""
        self._streams_of = [[streams[at.number] for at in each] for each in carried]
        self._answered = self._complete = False
        """Whether the last step took an answer, and whether all sensors took part in it that are not lost."""
        self._wake = RecentDistribution()
        self._exchange = RecentDistribution()
        self._started_ns = bus.clock.monotonic_ns()
        self._summarize_at_ns = 0
        self._summaries: list[tuple[dict[str, float], dict[str, float]]] = []

    def stop(self) -> None:
        """End `run` after the current cycle."""
        self.stopping = True

    def run(self) -> None:
        """The loop."""
        self._bus.next_frame = self._next_frame
        try:
            self._run()
        finally:
            self._bus.next_frame = self._bus.next_on_wire

    def _run(self) -> None:
        bus, hub, recovery, jobs, watchdog = self._bus, self._hub, self._recovery, self._jobs, self._watchdog
        timing, monotonic_ns, sleep = self._timing, bus.clock.monotonic_ns, bus.clock.sleep
        realtime_offset = self._streams[0].realtime_offset
        serve_by = roll_at = feed_at = look_at = 0
        while not self.stopping:
            due = self._due_ns()
            if jobs.waiting:
                jobs.step(due)
                due = self._due_ns()
            now, slept = monotonic_ns(), False
            if not timing.in_flight:
                if due > now or now > serve_by:
                    hub.serve(due)
                    serve_by = now + _SERVE_EVERY_NS
                    if (left := due - monotonic_ns()) > 0:  # the outlet had nothing to wait for
                        sleep(left * 1e-9)
                    slept = due > now
            elif now > serve_by:
                hub.serve(now)
                serve_by = now + _SERVE_IN_FLIGHT_NS
            self._answered = False
            self._step(due, (now if timing.in_flight else due) + _SERVE_EVERY_NS, slept=slept)
            now = monotonic_ns()
            if self._answered:
                recovery.attend(self._complete, now)
            elif timing.unanswered > 1:
                recovery.miss(now - timing.unanswered_since_ns, now)
            if now >= roll_at:
                roll_at = now + SLOT_NS
                self._roll()
            if now >= look_at:
                look_at = now + _REALTIME_EVERY_NS
                realtime_offset.follow()
            if now >= feed_at:
                feed_at = now + watchdog.feed_every_ns
                watchdog.feed()

    def _due_ns(self) -> int:
        """When the next exchange is due."""
        if self._recovery.all_lost:
            return self._timing.sent_ns + _RECOVERY_STEP_NS
        due = int(self._schedule.next_ns())
        blocked_until = self._bus.process_data.blocked_until_ns
        return due if due > blocked_until else blocked_until

    def _next_frame(self, until_ns: int) -> bytes | None:
        """The next frame before `until_ns` that answers no exchange; the exchanges go on meanwhile."""
        while True:
            in_time = self._bus.clock.monotonic_ns() < until_ns
            self._answered = False
            if (frame := self._step(self._due_ns(), until_ns)) is not None:
                return frame
            if not (in_time or self._answered):  # what had arrived by then is taken though this is late
                return None

    def _step(self, due: int, until_ns: int, *, slept: bool = False) -> bytes | None:
        """Hand out what arrives until the next exchange is `due`, then send it; return by `until_ns`.

        After it is sent its answer is awaited, until yet another one is due. Returns a frame that answers no
        exchange. `slept`: the loop has slept until it was due.
        """
        bus, timing, monotonic_ns = self._bus, self._timing, self._bus.clock.monotonic_ns
        frame, now = None, monotonic_ns()
        wait = (due if due < until_ns else until_ns) - now
        if wait > 0 or bus.process_data.in_flight or until_ns <= now:
            frame = self._receive(wait)
            if self._answered or (now := monotonic_ns()) < due:
                return frame
            slept = slept or wait > 0
        if (late := now - due) > self._schedule.shortest_ns:
            self._missed_deadlines += int(late // self._schedule.shortest_ns)
            if slept:  # else the answer was held up, and what is due was past when it came
                self._recovery.causes.stood_still(late, now)
        timing.sends(sent := bus.process_data.send())
        self._cycles += 1
        if slept:
            timing.woke(sent - due)
            self._wake.record(sent - due)
        for stream in self._streams:
            if now >= stream.idle_at_ns and (made := stream.idle(now)):
                self._hub.publish(((made[0], stream.number, made[1]),), now)
        if frame is None:
            most = int(timing.patience_ns) if self._schedule.one_by_one else self._due_ns() - monotonic_ns()
            if (wait := min(most, until_ns - now)) > 0:
                return self._receive(wait)
        return frame

    def _receive(self, wait: int) -> bytes | None:
        """Wait for a frame, `wait` ns at most, and hand it out; returns one that answers no exchange."""
        bus = self._bus
        frame = bus.backend.receive(wait * 1e-9 if wait > 0 else 0.0)
        back = bus.clock.monotonic_ns()
        if frame is None:
            return None
        while (sent := bus.process_data.take(frame)) < 0:
            # The answer may be behind duplicates of others: they must not pile up.
            if back > self._timing.sent_ns + _SERVE_EVERY_NS:
                return None
            frame, back = bus.backend.receive(0.0), bus.clock.monotonic_ns()
            if frame is None:
                return None
        if not sent:
            self._recovery.causes.stray(frame, back)
            return frame
        self._hand_out(sent, back)
        self._learn(sent, back)
        if len(self._streams) > 1:
            self._schedule.cost(bus.clock.monotonic_ns() - back)
        return None

    def _learn(self, sent: int, back: int) -> None:
        """Learn from the exchange that was taken last, once its samples are on their way."""
        timing, arrived = self._timing, self._bus.backend.arrived_ns()
        if not sent < arrived < back:  # the kernel does not say, or CLOCK_REALTIME was set
            arrived = back
        which = self._bus.process_data.which
        arrived = max(sent, arrived - self._wire_ns[which])
        if (late := back - sent - timing.usual_ns) > self._schedule.shortest_ns:  # the computer stood still
            self._missed_deadlines += int(late // self._schedule.shortest_ns)
            self._recovery.causes.stood_still(back - arrived - self._wire_ns[which], back)
        timing.took(sent, arrived)
        self._exchange.record(back - sent)
        for stream in self._streams_of[which]:
            if stream.learns:
                stream.learn(arrived)

    def _hand_out(self, sent: int, back: int) -> None:
        """Hand out what the exchange that was taken last brought."""
        process_data = self._bus.process_data
        frame, wkc, which = process_data.frame, process_data.wkc, process_data.which
        self._answered = True
        self._complete = complete = self._recovery.alive_wkc[which] <= wkc <= self._most_wkc[which]
        new: list[Made] = []
        for number, start, end, untouched, at, sensor, stream in self._carried[which]:
            if back < stream.clock.quiet_until_ns:
                continue  # the poll was for another sensor
            data = frame[start:end]
            # One that is out may be counted in place of one that is not there any more.
            if not complete or sensor.state is not SensorState.STREAMING or data == untouched:
                stream.invalid(wkc)
            elif made := stream.take(data, wkc, sent, back, LATCHED.unpack_from(frame, at) if at else None):
                new.append((made[0], number, made[1]))
        if new:
            self._hub.publish(new, back)

    def _roll(self) -> None:
        """Once a second."""
        self._wake.roll()
        self._exchange.roll()
        self._schedule.roll()
        self._round_trip.check()
        self._recovery.check()
        for stream in self._streams:
            stream.age.roll()
            stream.check()
            if stream.clock.events is None:
                self._bus.process_data.read_latched(stream.number, reads=False)
        self.every_second()

    def status(self) -> dict[str, Any]:
        """The cycle's part of the `status` reply."""
        now_ns = self._bus.clock.monotonic_ns()
        if now_ns >= self._summarize_at_ns:
            self._summarize_at_ns = now_ns + _SUMMARY_NS
            everyone = (self._wake, self._exchange, *(stream.age for stream in self._streams))
            self._summaries = [distribution.summaries_us() for distribution in everyone]
        (wake, recent_wake), (exchange, recent_exchange), *ages = self._summaries
        return {
            "cycles": self._cycles,
            "round_trip": self._timing.describe(),
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
