"""The acquisition loop: exchange, hand out, serve the sockets until the next deadline.

The sensors' clocks say when the next exchange is due, as absolute times on CLOCK_MONOTONIC. One thread does
everything, and `run` is all of the hot path outside `SensorStream.take` and `Connection.offer`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from ethercat_server.acquisition.histogram import SLOT_NS, RecentDistribution
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.stream import SensorStream
from ethercat_server.ethercat.bus import Bus
from ethercat_server.sensor.sensor import Sensor, SensorState

_SERVE_MARGIN_NS: Final = 80_000
"""Sockets are not served this shortly before a deadline: select may wake late."""
_SERVE_EVERY_NS: Final = 10_000_000
"""Sockets are served this often even if every deadline has passed."""
_TIMEOUT_PERIODS: Final = 0.75
"""Timeout of a frame in shortest sample periods, so that the next one is in time."""
_LEAST_TIMEOUT_S: Final = 300e-6
_RECOVERY_STEP_NS: Final = 500_000
"""Time between two exchanges while all sensors are lost."""
_RECOVERY_TIMEOUT_S: Final = 0.02
"""Timeout of a frame meanwhile."""
_SUMMARY_NS: Final = 200_000_000
"""Interval between summaries of the distributions, which take some 100 µs each."""
_LATENESS_GAIN: Final = 1 / 64
_MAX_LEAD_NS: Final = 200_000.0


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
        self._lost_frames = 0
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
        bus, hub, streams, recovery = self._bus, self._hub, self._streams, self._recovery
        jobs, watchdog = self._jobs, self._watchdog
        each = tuple(zip(self._sensors, streams, strict=True))
        monotonic_ns, sleep = bus.clock.monotonic_ns, bus.clock.sleep
        shortest_ns, timeout_s = self._limits()
        lead_ns = 0.0  # usual lateness of wake-ups, by which deadlines are brought forward
        serve_by = roll_at = feed_at = 0
        while not self.stopping:
            now = monotonic_ns()
            deadline = int(min([stream.clock.next_poll_ns() for stream in streams]) - lead_ns)
            wait_s = timeout_s
            if recovery.all_lost:
                deadline, wait_s = now + _RECOVERY_STEP_NS, _RECOVERY_TIMEOUT_S
            if jobs.waiting:
                jobs.step(deadline)
            if deadline > now or now > serve_by:
                hub.serve(deadline - _SERVE_MARGIN_NS)
                serve_by = now + _SERVE_EVERY_NS
            slept = deadline > now
            if slept and (left := deadline - monotonic_ns()) > 0:
                sleep(left * 1e-9)
            sent = monotonic_ns()
            if slept:
                late = sent - deadline
                lead_ns += _LATENESS_GAIN * (min(late, _MAX_LEAD_NS) - lead_ns)
                self._wake.record(late)
                self._missed_deadlines += int(max(late, 0) // shortest_ns)
            bus.send(sent)
            wkc = bus.receive(wait_s)
            back = monotonic_ns()
            complete = wkc >= recovery.alive_wkc
            for sensor, stream in each:
                data = bus.process_data(number := stream.number)
                # One that is out may be counted in place of one that is not there any more.
                valid = complete and sensor.state is SensorState.STREAMING and data != bus.untouched[number]
                if made := stream.take(data, wkc, valid, sent, back):
                    hub.publish(made[0], number, made[1], back)
            for stream in streams:
                stream.learn()
            recovery.attend(wkc, back)
            if back >= roll_at:
                roll_at = back + SLOT_NS
                self._roll()
                shortest_ns, timeout_s = self._limits()
            if back >= feed_at:
                feed_at = back + watchdog.feed_every_ns
                watchdog.feed()
            self._cycles += 1
            self._lost_frames += wkc < 0
            self._exchange.record(back - sent)
            if back - sent > shortest_ns and wkc >= 0:  # the computer stood still meanwhile
                self._missed_deadlines += int((back - sent) // shortest_ns)

    def _limits(self) -> tuple[float, float]:
        """The shortest sample period in ns and how long a frame may take in s; both change with the rates."""
        shortest_ns = min(stream.clock.period_ns for stream in self._streams)
        return shortest_ns, max(_LEAST_TIMEOUT_S, _TIMEOUT_PERIODS * 1e-9 * shortest_ns)

    def _roll(self) -> None:
        """Once a second."""
        self._wake.roll()
        self._exchange.roll()
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
            "lost_frames": self._lost_frames,
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
