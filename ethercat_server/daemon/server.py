"""One run of the server: start-up, acquisition loop, shutdown."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
from collections.abc import Sequence

from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.acquisition.jobs import Jobs
from ethercat_server.acquisition.recovery import Recovery
from ethercat_server.acquisition.start_up import bring_up
from ethercat_server.acquisition.stream import make_streams
from ethercat_server.acquisition.timing.exchange_timing import ExchangeTiming
from ethercat_server.daemon.options import ServerOptions, parse_options
from ethercat_server.daemon.service import Policy, Service
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.master.soem import SoemBackend
from ethercat_server.ethercat.nic.claim import claimed
from ethercat_server.process import realtime
from ethercat_server.process.notify import Notifier
from ethercat_server.process.privileges import User, become, user_to_become
from ethercat_server.process.signals import Signals
from ethercat_server.sensor.others import Others
from ethercat_server.serving.actions import Actions
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.sensor_actions import SensorActions
from ethercat_server.serving.transport.sockets import SocketTransport
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus
from protocol.control import Event, event

log = logging.getLogger(__name__)


def serve(argv: Sequence[str] | None, signals: Signals) -> None:
    """Start up, stream until asked to stop, shut down; ServerError says what failed."""
    options = parse_options(argv)
    user = user_to_become(options.server["user"])
    policy, notifier = Policy(options), Notifier()
    with contextlib.ExitStack() as cleanup:
        hub = Hub(SocketTransport(options.server["hosts"], options.port))
        cleanup.callback(hub.close)
        ifname, priority = options.ifname, options.server["rt_priority"]
        if options.is_virtual:
            ifname = cleanup.enter_context(_virtual_bus(options)).ifname
        cleanup.enter_context(claimed(ifname, allow_ip=options.allow_ip))
        backend = SoemBackend(ifname)
        bus = Bus(backend)
        backend.on_emergency = bus.emergencies.note
        cleanup.callback(bus.close)
        backend.open()
        realtime.prepare(priority, options.server["cpu"], becomes_user=user is not None)
        _give_up_root(user, options)
        policy.apply(hub)
        sensors, slaves = bring_up(bus, options, signals.check)
        timing = ExchangeTiming(bus.clock.monotonic_ns())
        streams = make_streams(bus, sensors, timing)
        others = Others(bus, slaves)
        recovery, jobs = Recovery(bus, sensors, streams, hub.broadcast, others), Jobs(bus, sensors)
        cycle = Cycle(bus, sensors, streams, timing, hub, recovery, jobs, notifier)
        on_sensors = SensorActions(bus, hub, recovery, jobs, sensors, streams)
        service = Service(argv, policy, hub, on_sensors, notifier)
        cycle.every_second = service.every_second
        signals.call(cycle.stop, service.reload)
        hub.start(
            Actions(hub, cycle, on_sensors, {"others": others.rows, "interface": options.ifname}).handle
        )
        for sensor in sensors:
            log.info(
                "sensor %d: %s, serial %d, firmware %s, %d bytes at %d Hz",
                sensor.number, sensor.identity.name, sensor.identity.serial, sensor.identity.firmware,
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
        log.info("shutting down: the sensors go to INIT")


def _virtual_bus(options: ServerOptions) -> VirtualBus:
    # By the port two such servers have different sensors, each the same every time.
    server = options.server
    return VirtualBus(options.virtual_arguments, server["rt_priority"], server["user"], options.port)


def _give_up_root(user: User | None, options: ServerOptions) -> None:
    """Become `user`; what that will hinder is logged now."""
    if user is None:
        if os.geteuid() == 0 and options.server["user"] is None:
            log.warning("running as root: name a user with --user ([server] user), or start it with sudo")
        return
    become(user)
    log.info("running as user %s from here on, without privileges", user)
    if options.config is not None and not os.access(options.config, os.R_OK):
        log.warning("user %s cannot read the configuration %s: a reload will fail", user, options.config)
