"""`ethercat-server`: reads the command line, brings everything up, runs the loop, takes everything down."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType

from ethercat_server import realtime
from ethercat_server.actions import Actions
from ethercat_server.bus import Bus
from ethercat_server.cycle import Cycle
from ethercat_server.errors import ServerError, StopRequestedError
from ethercat_server.hub import Hub
from ethercat_server.interface import check_interface
from ethercat_server.jobs import Jobs
from ethercat_server.logs import set_up_logging
from ethercat_server.notify import Notifier
from ethercat_server.options import parse_options
from ethercat_server.recovery import Recovery
from ethercat_server.sensor_actions import SensorActions
from ethercat_server.service import Policy, Service
from ethercat_server.start_up import bring_up
from ethercat_server.stream import SensorStream
from ethercat_server.virtual_bus import VirtualBus
from protocol.control import Event, event

log = logging.getLogger("ethercat-server")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the server; returns its exit code."""
    set_up_logging()
    try:
        serve(argv)
    except StopRequestedError:
        log.info("stopped before it was up")
    except ServerError as error:
        print(f"ethercat-server: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def serve(argv: Sequence[str] | None) -> None:
    """Bring everything up, stream until asked to stop, take everything down; ServerError says what failed."""
    options = parse_options(argv)
    policy, notifier = Policy(options), Notifier()
    signals = _Signals()
    with contextlib.ExitStack() as cleanup:
        hub = Hub(options.server["hosts"], options.port)
        cleanup.callback(hub.close)
        policy.apply(hub)
        ifname, priority = options.ifname, options.server["rt_priority"]
        if options.is_virtual:
            ifname = cleanup.enter_context(VirtualBus(options.virtual_arguments, priority)).ifname
        check_interface(ifname)
        bus = Bus(ifname)
        bus.open()
        cleanup.callback(bus.close)
        sensors = bring_up(bus, options, signals.check)
        realtime.prepare(priority, options.server["cpu"])
        streams = [SensorStream(sensor.place, sensor.period_ns) for sensor in sensors]
        recovery, jobs = Recovery(bus, sensors, streams, hub.broadcast), Jobs(bus, streams)
        cycle = Cycle(bus, streams, hub, recovery, jobs, notifier)
        service = Service(argv, policy, hub, sensors, notifier)
        cycle.every_second = service.every_second
        signals.call(cycle.stop, service.reload)
        hub.start(Actions(hub, cycle, SensorActions(hub, recovery, jobs, sensors, streams)).handle)
        for sensor in sensors:
            log.info(
                "sensor %d: %s, serial %d, firmware %s, %d bytes at %d Hz",
                sensor.place, sensor.identity.name, sensor.identity.serial, sensor.identity.firmware,
                sensor.pdo_size, sensor.rate_hz,
            )  # fmt: skip
        log.info("streaming %s on port %d", ifname, options.port)
        service.ready()
        try:
            cycle.run()
        finally:
            notifier.stopping()
            hub.broadcast(event(Event.SHUTTING_DOWN))
        log.info("stopping: the bus goes to INIT")


class _Signals:
    """SIGINT and SIGTERM stop, SIGHUP reloads: noticed between start-up's steps, then passed on."""

    def __init__(self) -> None:
        self._stop: Callable[[], None] | None = None
        self._received = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_stop)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until there is something to reload for

    def check(self) -> None:
        """StopRequestedError if a signal has come."""
        if self._received:
            raise StopRequestedError("asked to stop while starting")

    def call(self, stop: Callable[[], None], reload: Callable[[], None]) -> None:
        """From now on a signal calls `stop` or `reload`."""
        self._stop = stop
        signal.signal(signal.SIGHUP, lambda *_: reload())
        if self._received:
            stop()

    def _on_stop(self, _number: int, _frame: FrameType | None) -> None:
        self._received = True
        if self._stop is not None:
            self._stop()


if __name__ == "__main__":
    sys.exit(main())
