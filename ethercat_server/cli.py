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
from ethercat_server.options import ServerOptions, parse_options
from ethercat_server.recovery import Recovery
from ethercat_server.start_up import bring_up
from ethercat_server.stream import SensorStream
from ethercat_server.virtual_bus import VirtualBus
from protocol.control import Event, event

log = logging.getLogger("ethercat-server")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the server; returns its exit code."""
    logging.basicConfig(format="ethercat-server: %(message)s", level=logging.INFO, stream=sys.stderr)
    try:
        serve(parse_options(argv))
    except StopRequestedError:
        log.info("stopped before it was up")
    except ServerError as error:
        print(f"ethercat-server: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def serve(options: ServerOptions) -> None:
    """Bring everything up, stream until asked to stop, take everything down; ServerError says what failed."""
    signals = _StopSignals()
    with contextlib.ExitStack() as cleanup:
        hub = Hub(options.hosts, options.port)
        cleanup.callback(hub.close)
        ifname = options.ifname
        if options.is_virtual:
            ifname = cleanup.enter_context(VirtualBus(options.virtual_arguments, options.rt_priority)).ifname
        check_interface(ifname)
        bus = Bus(ifname)
        bus.open()
        cleanup.callback(bus.close)
        sensors = bring_up(bus, options, signals.check)
        realtime.prepare(options.rt_priority, options.cpu)
        streams = [SensorStream(sensor.place, sensor.period_ns) for sensor in sensors]
        cycle = Cycle(bus, streams, hub, Recovery(bus, sensors, streams, hub.broadcast))
        signals.call(cycle.stop)
        hub.start(Actions(hub, cycle, sensors).handle)
        for sensor in sensors:
            log.info(
                "sensor %d: %s, serial %d, firmware %s, %d bytes at %d Hz",
                sensor.place, sensor.identity.name, sensor.identity.serial, sensor.identity.firmware,
                sensor.pdo_size, sensor.rate_hz,
            )  # fmt: skip
        log.info("streaming %s on port %d", ifname, options.port)
        try:
            cycle.run()
        finally:
            hub.broadcast(event(Event.SHUTTING_DOWN))
        log.info("stopping: the bus goes to INIT")


class _StopSignals:
    """SIGINT and SIGTERM: noticed between start-up's steps, then passed on to the loop."""

    def __init__(self) -> None:
        self._stop: Callable[[], None] | None = None
        self._received = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def check(self) -> None:
        """StopRequestedError if a signal has come."""
        if self._received:
            raise StopRequestedError("asked to stop while starting")

    def call(self, stop: Callable[[], None]) -> None:
        """From now on a signal calls `stop`."""
        self._stop = stop
        if self._received:
            stop()

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._received = True
        if self._stop is not None:
            self._stop()


if __name__ == "__main__":
    sys.exit(main())
