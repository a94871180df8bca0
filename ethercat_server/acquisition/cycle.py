"""The acquisition loop: exchange, hand out, serve the sockets until the next exchange is due.

The schedule says when that is, as an absolute time on CLOCK_MONOTONIC; answers are handed out whenever they
arrive, so that a slow network card has several exchanges on their way. One thread does everything, and
`_step` with `_hand_out` is all of the hot path outside `SensorStream.take` and `Connection.offer`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from ethercat_server.acquisition.histogram import SLOT_NS, RecentDistribution
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.acquisition.timing.schedule import Schedule
from ethercat_server.ethercat.bus import Bus
from ethercat_server.sensor.sensor import Sensor, SensorState

_SERVE_MARGIN_NS: Final = 80_000
"""Sockets are not served this shortly before a deadline: select may wake late."""
_SERVE_EVERY_NS: Final = 10_000_000
"""Sockets are served this often even if every deadline has passed."""
_RECOVERY_STEP_NS: Final = 500_000
"""Time between two exchanges while all sensors are lost."""
_SUMMARY_NS: Final = 200_000_000
"""Interval between summaries of the distributions, which take some 100 µs each."""


class Outlet(Protocol):
    """Where the samples go: the server's `Hub`, or a tool that wants them in its own process."""

    def publish(self, frame: bytes, number: int, flags: int, now_ns: int) -> None:
        """Take a DATA frame of the sensor `number`; `now_ns` is when its exchange was back."""
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
        carried = bus.process_data.inputs
        self._carried = [[(at, sensors[at.number], streams[at.number]) for at in each] for each in carried]
        """By frame of the exchange: what it carries of which sensor."""
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
        bus, hub, recovery, jobs, watchdog = self._bus, self._hub, self._recovery, self._jobs, self._watchdog
        process_data, monotonic_ns = bus.process_data, bus.clock.monotonic_ns
        bus.next_frame = self._next_frame
        serve_by = roll_at = feed_at = 0
        while not self.stopping:
            now = monotonic_ns()
            due = self._due_ns()
            if jobs.waiting:
                jobs.step(due)
            if now > serve_by or (due > now and not process_data.in_flight):
                hub.serve(
                    min(due - _SERVE_MARGIN_NS, now) if process_data.in_flight else due - _SERVE_MARGIN_NS
                )
                serve_by = now + _SERVE_EVERY_NS
            self._answered = False
            self._step(due + _RECOVERY_STEP_NS)
            now = monotonic_ns()
            if self._answered:
                recovery.attend(self._complete, now)
            elif process_data.unanswered > 1:
                recovery.miss(now - process_data.waiting_since_ns, now)
            if now >= roll_at:
                roll_at = now + SLOT_NS
                self._roll()
            if now >= feed_at:
                feed_at = now + watchdog.feed_every_ns
                watchdog.feed()
        bus.next_frame = bus.next_on_wire

    def _due_ns(self) -> int:
        if self._recovery.all_lost:
            return self._timing.sent_ns + _RECOVERY_STEP_NS
        return max(int(self._schedule.next_ns()), self._bus.process_data.blocked_until_ns)

    def _next_frame(self, until_ns: int) -> bytes | None:
        """The next frame before `until_ns` that answers no exchange; the exchanges go on meanwhile."""
        while True:
            in_time = self._bus.clock.monotonic_ns() < until_ns
            self._answered = False
            if (frame := self._step(until_ns)) is not None:
                return frame
            if not (in_time or self._answered):  # what had arrived by then is taken though this is late
                return None

    def _step(self, until_ns: int) -> bytes | None:
        """Hand out what arrives, or send the next exchange once it is due; return by `until_ns`.

        Returns a frame that is no answer to an exchange.
        """
        bus, monotonic_ns = self._bus, self._bus.clock.monotonic_ns
        process_data, timing = bus.process_data, self._timing
        due, now, frame = self._due_ns(), monotonic_ns(), None
        if (wait := min(due, until_ns) - now) > 0 or process_data.in_flight or until_ns <= now:
            frame = bus.backend.receive(wait * 1e-9 if wait > 0 else 0.0)
            now = monotonic_ns()
            if frame is not None and (sent := process_data.take(frame)):
                timing.took(sent, now)
                self._exchange.record(now - sent)
                self._hand_out(sent, now)
                self._schedule.cost(monotonic_ns() - now)
                self._missed_deadlines += max(0, int((now - due) // self._schedule.shortest_ns))
                return None
            if now < due:
                return frame
            if wait > 0:
                timing.woke(now - due)
                self._wake.record(now - due)
        self._missed_deadlines += int((now - due) // self._schedule.shortest_ns)
        timing.sent_ns, timing.in_flight = now, True
        self._cycles += 1
        process_data.send(now)
        for stream in self._streams:
            if now >= stream.idle_at_ns and (made := stream.idle(now)):
                self._hub.publish(made[0], stream.number, made[1], now)
        return frame

    def _hand_out(self, sent: int, back: int) -> None:
        """Hand out what the exchange that was taken last brought."""
        process_data = self._bus.process_data
        frame, wkc, which = process_data.frame, process_data.wkc, process_data.which
        self._answered = True
        self._complete = complete = wkc >= self._recovery.alive_wkc[which]
        carried = self._carried[which]
        for at, sensor, stream in carried:
            data = frame[at.start : at.end]
            # One that is out may be counted in place of one that is not there any more.
            if not complete or sensor.state is not SensorState.STREAMING or data == at.untouched:
                stream.invalid(wkc)
            elif made := stream.take(data, wkc, sent, back):
                self._hub.publish(made[0], at.number, made[1], back)
        for _, _, stream in carried:
            stream.learn()

    def _roll(self) -> None:
        """Once a second."""
        self._wake.roll()
        self._exchange.roll()
        self._schedule.roll()
        for stream in self._streams:
            stream.age.roll()
            stream.check()
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
            "missed_deadlines": self._missed_deadlines,
            "lost_frames": self._bus.process_data.lost,
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
