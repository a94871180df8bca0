"""The acquisition loop: exchange, hand out, serve the sockets until the next deadline.

The sensors' clocks say when the next exchange is due, as absolute times on CLOCK_MONOTONIC. One thread does
everything, and `run` is all of the hot path outside `SensorStream.take` and `Connection.offer`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Final

from ethercat_server.bus import Bus
from ethercat_server.distribution import Distribution
from ethercat_server.hub import Hub
from ethercat_server.stream import SensorStream

_SERVE_MARGIN_NS: Final = 80_000
"""Sockets are left alone this long before a deadline: select may wake late."""
_SERVE_EVERY_NS: Final = 10_000_000
"""The sockets' turn comes this often even if the deadlines leave no time."""
_LATENESS_GAIN: Final = 1 / 64
_MAX_LEAD_NS: Final = 200_000.0


class Cycle:
    """Reads the sensors and hands their samples to the hub until told to stop."""

    def __init__(self, bus: Bus, streams: Sequence[SensorStream], hub: Hub) -> None:
        self.stopping = False
        self._bus = bus
        self._streams = streams
        self._hub = hub
        self._cycles = 0
        self._missed_deadlines = 0
        self._lost_frames = 0
        self._wake = Distribution()
        self._exchange = Distribution()
        self._started = time.monotonic()

    def stop(self) -> None:
        """End `run` after the current cycle."""
        self.stopping = True

    def run(self) -> None:
        """The loop."""
        bus, hub, streams = self._bus, self._hub, self._streams
        expected_wkc, monotonic_ns, sleep = bus.expected_wkc, time.monotonic_ns, time.sleep
        shortest_ns = min(stream.clock.period_ns for stream in streams)
        timeout_s = max(300e-6, 0.75e-9 * shortest_ns)
        lead_ns = 0.0  # how late this thread usually wakes: deadlines are brought forward by it
        serve_by = 0
        while not self.stopping:
            now = monotonic_ns()
            deadline = int(min([stream.clock.next_poll_ns() for stream in streams]) - lead_ns)
            if deadline > now or now > serve_by:
                hub.serve(deadline - _SERVE_MARGIN_NS)
                serve_by = now + _SERVE_EVERY_NS
                if (left := deadline - monotonic_ns()) > 0:
                    sleep(left * 1e-9)
                sent = monotonic_ns()
                late = sent - deadline
                lead_ns += _LATENESS_GAIN * (min(late, _MAX_LEAD_NS) - lead_ns)
                self._wake.record(late)
                if late > shortest_ns:
                    self._missed_deadlines += int(late // shortest_ns)
            else:
                sent = now
            wkc = bus.exchange(timeout_s)
            back = monotonic_ns()
            for stream in streams:
                made = stream.take(bus.process_data(stream.place), wkc, wkc >= expected_wkc, sent, back)
                if made:
                    hub.publish(made[0], stream.place, made[1], back)
            self._cycles += 1
            self._lost_frames += wkc < 0
            self._exchange.record(back - sent)

    def status(self) -> dict[str, Any]:
        """The cycle's part of the `status` reply."""
        return {
            "cycles": self._cycles,
            "missed_deadlines": self._missed_deadlines,
            "lost_frames": self._lost_frames,
            "wake_us": self._wake.summary_us(),
            "exchange_us": self._exchange.summary_us(),
            "sensors": [stream.status() for stream in self._streams],
            "uptime_s": round(time.monotonic() - self._started, 3),
        }
