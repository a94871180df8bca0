"""One run of the server: brings everything up, runs the loop, takes everything down."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
from collections.abc import Sequence

from ethercat_server import realtime
from ethercat_server.actions import Actions
from ethercat_server.bus import Bus
from ethercat_server.cycle import Cycle
from ethercat_server.hub import Hub
from ethercat_server.interface import claimed
from ethercat_server.jobs import Jobs
from ethercat_server.notify import Notifier
from ethercat_server.options import parse_options
from ethercat_server.recovery import Recovery
from ethercat_server.sensor_actions import SensorActions
from ethercat_server.service import Policy, Service
from ethercat_server.signals import Signals
from ethercat_server.start_up import bring_up
from ethercat_server.stream import SensorStream
from ethercat_server.virtual_bus import VirtualBus
from protocol.control import Event, event

log = logging.getLogger(__name__)


def serve(argv: Sequence[str] | None, signals: Signals) -> None:
    """Bring everything up, stream until asked to stop, take everything down; ServerError says what failed."""
    options = parse_options(argv)
    policy, notifier = Policy(options), Notifier()
    with contextlib.ExitStack() as cleanup:
        hub = Hub(options.server["hosts"], options.port)
        cleanup.callback(hub.close)
        policy.apply(hub)
        ifname, priority = options.ifname, options.server["rt_priority"]
        if options.is_virtual:
            ifname = cleanup.enter_context(VirtualBus(options.virtual_arguments, priority)).ifname
        cleanup.enter_context(claimed(ifname))
        bus = Bus(ifname)
        cleanup.callback(bus.close)
        bus.open()
        sensors = bring_up(bus, options, signals.check)
        realtime.prepare(priority, options.server["cpu"])
        streams = [SensorStream(sensor.place, sensor.period_ns) for sensor in sensors]
        recovery, jobs = Recovery(bus, sensors, streams, hub.broadcast), Jobs(bus, streams)
        cycle = Cycle(bus, streams, hub, recovery, jobs, notifier)
        on_sensors = SensorActions(bus, hub, recovery, jobs, sensors, streams)
        service = Service(argv, policy, hub, on_sensors, notifier)
        cycle.every_second = service.every_second
        signals.call(cycle.stop, service.reload)
        hub.start(Actions(hub, cycle, on_sensors).handle)
        for sensor in sensors:
            log.info(
                "sensor %d: %s, serial %d, firmware %s, %d bytes at %d Hz",
                sensor.place, sensor.identity.name, sensor.identity.serial, sensor.identity.firmware,
                sensor.pdo_size, sensor.rate_hz,
            )  # fmt: skip
        for host in options.server["hosts"]:
            if not ipaddress.ip_address(host).is_loopback:
                log.warning("listening on %s: every machine that can reach it may read the sensors", host)
        log.info("streaming %s on port %d", ifname, options.port)
        service.ready()
        try:
            cycle.run()
        finally:
            notifier.stopping()
            hub.broadcast(event(Event.SHUTTING_DOWN))
        log.info("stopping: the bus goes to INIT")
