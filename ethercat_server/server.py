"""The one assembly of a server: on an open bus, with a hub for its clients, it streams, answers and stops.

The daemon, the private server of `ethercat-sensor` and `ethercat-doctor`, and the tests are this class.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bota_ethercat.control import Event, event
from ethercat_server.acquisition.acyclic import Acyclic
from ethercat_server.acquisition.cycle import Cycle, Watchdog
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.start_up import Wanted, bring_up
from ethercat_server.acquisition.stream import make_streams
from ethercat_server.acquisition.terminals import CycleWithTerminals
from ethercat_server.ethercat.bus import Bus
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sensor.scan import OtherSlaves
from ethercat_server.serving.actions import Actions
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.sensor_actions import SensorActions


class NoWatchdog:
    """No watchdog is configured."""

    feed_every_ns = 1 << 62

    def feed(self) -> None:
        """Nothing is fed."""


class Server:
    """Every sensor of a bus, streamed to the clients of a hub.

    Attributes:
        bus: the open bus.
        hub: the clients.
        sensors: by number.
        streams: their samples, by number.
        others: the slaves that are no sensors.
        recovery: what brings lost sensors back.
        jobs: what clients asked for and is under way.
        actions: what acts on the sensors for clients.
        cycle: the loop.
    """

    def __init__(
        self,
        bus: Bus,
        hub: Hub,
        wanted: Wanted,
        check_interrupt: Callable[[], None] = lambda: None,
        *,
        watchdog: Watchdog | None = None,
        extra: dict[str, Any] | None = None,
    ) -> None:
        """Take the sensors to OP with the `wanted` settings; ServerError says why one cannot be.

        `check_interrupt` is called between the steps and may raise to give up; `extra` is added to the reply
        of `describe`.
        """
        self.bus, self.hub = bus, hub
        self.sensors, slaves, terminals = bring_up(bus, wanted, check_interrupt)
        round_trip = RoundTrip(max(bus.process_data.wire_ns))
        self.streams = make_streams(bus, self.sensors, round_trip)
        self.others, acyclic = OtherSlaves(bus, slaves), Acyclic(bus)
        self.recovery = Recovery(bus, acyclic, self.sensors, self.streams, hub.broadcast, self.others)
        self.jobs = Jobs(acyclic, self.sensors)
        self.cycle = (CycleWithTerminals if terminals else Cycle)(
            bus, self.sensors, self.streams, round_trip, hub, acyclic, self.recovery, self.jobs,
            watchdog or NoWatchdog(),
        )  # fmt: skip
        if isinstance(self.cycle, CycleWithTerminals):
            self.cycle.terminals = terminals
            for terminal in terminals:
                acyclic.start(terminal.steps)
        self.actions = SensorActions(bus, hub, self.recovery, self.jobs, self.sensors, self.streams)
        rows = [terminal.row for terminal in terminals]
        described = {
            "others": self.others.rows,
            **({"terminals": rows} if terminals else {}),
            **(extra or {}),
        }
        hub.start(
            Actions(hub, self.cycle, self.actions, lambda: {"interface": bus.ifname, **described}).handle
        )

    def run(self) -> None:
        """Stream until `stop`; then tell the clients."""
        try:
            self.cycle.run()
        finally:
            self.hub.broadcast(event(Event.SHUTTING_DOWN))

    def stop(self) -> None:
        """End `run` soon; from any thread, and in a signal handler."""
        self.cycle.stop()
