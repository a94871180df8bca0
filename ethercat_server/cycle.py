"""The acquisition loop: exchange, hand out, serve the sockets until the next deadline.

Deadlines are absolute on CLOCK_MONOTONIC and never drift. One that is missed is skipped and counted; no
burst follows.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Final

from ethercat_server.bus import Bus
from ethercat_server.distribution import Distribution
from ethercat_server.hub import Hub
from ethercat_server.stream import SensorStream

_POLLS_PER_SAMPLE: Final = 3
_SERVE_MARGIN_NS: Final = 80_000
"""Sockets are left alone this long before a deadline: select may wake late."""
_EXCHANGE_TIMEOUT_S: Final = 0.001


class Cycle:
    """Reads the sensors and hands their samples to the hub until told to stop."""

    def __init__(self, bus: Bus, streams: Sequence[SensorStream], hub: Hub) -> None:
        self.stopping = False
        self._bus = bus
        self._streams = streams
        self._hub = hub
        self._period_ns = min(stream.period_ns for stream in streams) // _POLLS_PER_SAMPLE
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
        bus, hub, streams, period = self._bus, self._hub, self._streams, self._period_ns
        expected_wkc, monotonic_ns = bus.expected_wkc, time.monotonic_ns
        deadline = monotonic_ns() + period
        while not self.stopping:
            hub.serve(deadline - _SERVE_MARGIN_NS)
            if (left := deadline - monotonic_ns()) > 0:
                time.sleep(left * 1e-9)
            woke = monotonic_ns()
            wkc = bus.exchange(_EXCHANGE_TIMEOUT_S)
            back = monotonic_ns()
            for stream in streams:
                made = stream.take(bus.process_data(stream.place), wkc, wkc >= expected_wkc, back)
                if made:
                    hub.publish(made[0], stream.place, made[1], back)
            self._cycles += 1
            self._lost_frames += wkc < 0
            self._wake.record(woke - deadline)
            self._exchange.record(back - woke)
            deadline += period
            if deadline <= back:
                missed = (back - deadline) // period + 1
                self._missed_deadlines += missed
                deadline += missed * period

    def status(self) -> dict[str, Any]:
        """The cycle's part of the `status` reply."""
        return {
            "cycles": self._cycles,
            "missed_deadlines": self._missed_deadlines,
            "lost_frames": self._lost_frames,
            "wake_us": self._wake.summary_us(),
            "exchange_us": self._exchange.summary_us(),
            "sensors": [stream.counters() for stream in self._streams],
            "uptime_s": round(time.monotonic() - self._started, 3),
        }
