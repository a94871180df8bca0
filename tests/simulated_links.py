"""The buses of the tool and the doctor in memory: no processes, no interface, no real time.

    with simulated_bus("--serial", "10,20") as bus:
        bus.command("power cycle 0.5")
        result = run_here(main, "plan", bus.near, "--set", "fir=on")
        assert bus.written(1) == []

Within `simulated_bus` whatever opens an interface gets these virtual sensors; within `simulated_server`
whatever connects to a server gets one that streams them. Time passes only while somebody waits.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import pytest

from bota_ethercat.client import Client, client
from ethercat_server.access import private_server, raw, sensors
from ethercat_server.access.sensors import Sensors
from ethercat_server.acquisition.start_up import AsFound, Wanted
from ethercat_server.doctor import bus_checks
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import ByPosition
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.ethercat.slave.sii import read_sii
from ethercat_server.process import realtime
from ethercat_server.sensor import scan
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.cli import build_parser, options_from
from ethercat_server.virtual_sensor.foreign.chain import parse_chain, slaves_in
from tests.simulation import MemoryChannel, SimulatedBus, Simulation

SINC_LENGTH, RATE_HZ = 512, 100
"""What a server sets the sensors to: the fewer samples, the faster it is simulated."""


_READ_IMAGE = scan.read_image


def _read_image(bus: Bus, position: int, check_interrupt: CheckInterrupt = lambda: None) -> bytes:
    """The SII, on which most of a start would be spent; nothing else reads it like this."""
    finish(read_sii(ByPosition(bus), position, 0, 4), clock=bus.clock)
    assert isinstance(bus.backend, MemoryBackend)
    life = bus.backend.sensors.slaves[position].life
    return _READ_IMAGE(bus, position, check_interrupt) if life is None else life.esc.sii.image


def chain(text: str) -> MemoryBackend:
    """A bus with these slaves."""
    return MemoryBackend(*slaves_in(parse_chain(text)))


def registers(backend: MemoryBackend) -> list[bytes]:
    """All registers of every slave."""
    lives = [slave.life for slave in backend.sensors.slaves]
    return [bytes(life.esc.memory[: reg.REGISTERS_END]) for life in lives if life is not None]


@contextlib.contextmanager
def simulated_bus(*arguments: object, machine: Machine | None = None) -> Iterator[SimulatedBus]:
    """Sensors as `ethercat-virtual-sensor IFACE arguments...` simulates; nobody writes their calibration."""
    options = options_from(build_parser().parse_args(["lo", *map(str, arguments)]))
    bus = SimulatedBus(MemoryBackend(*options.slaves, machine=machine))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan, "read_image", _read_image)
        for module in (raw, bus_checks):
            patch.setattr(module, "open_bus", lambda _ifname, **_: contextlib.closing(Bus(bus.backend)))

        def private(_ifname: str, *, force: bool = False, **_: object) -> PrivateServer:
            server = PrivateServer(bus, AsFound(force=force))
            patch.setattr(Sensors, "clock", server.clients_clock)
            return server

        patch.setattr(sensors, "PrivateServer", private)
        patch.setattr(realtime, "prepare", lambda _priority, _cpu: None)
        yield bus
    assert not any(bus.stats(position)["calibration_writes"] for position in range(len(options.sensors)))


class SimulatedServer(Simulation):
    """A server that streams the sensors of a bus, while somebody waits for something from it."""

    address = "localhost:12001"

    def __init__(self, bus: SimulatedBus, wanted: Wanted | None = None) -> None:
        # Here a message comes a period late, because time passes while the server serves: ages mean nothing.
        super().__init__(
            backend=bus.backend, settings={"sinc_length": SINC_LENGTH}, wanted=wanted, boot_id="simulated"
        )
        self.clients_clock = _ServersClock(self)
        self.hangs = False
        """Whether it is stopped by somebody."""

    def go_on(self, until: Callable[[], object], seconds: float) -> None:
        """See `Simulation`."""
        if self.hangs:
            self.clock.sleep(seconds)
        else:
            super().go_on(until, seconds)

    def client(self) -> Client:
        """A client for this test's own requests."""
        return Client(12001, stream=False, channel=MemoryChannel(self, buffer_size=1 << 20)).connect()


class PrivateServer(SimulatedServer):
    """One that a program has for itself."""

    error = None
    real_time = True

    def __init__(self, bus: SimulatedBus, wanted: Wanted) -> None:
        super().__init__(bus, wanted)
        self.channel = MemoryChannel(self, buffer_size=1 << 20)

    def interrupt(self) -> None:
        """See `PrivateServer`."""
        self.server.jobs.interrupt(private_server.STOPPED)


@contextlib.contextmanager
def simulated_server(bus: SimulatedBus) -> Iterator[SimulatedServer]:
    """A server that streams from `bus`, behind every address."""
    server = SimulatedServer(bus)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(client, "TcpChannel", lambda *_: MemoryChannel(server, buffer_size=1 << 20))
        patch.setattr(Sensors, "clock", server.clients_clock)
        yield server


class _ServersClock:
    """A client's time: while it sleeps, the server goes on."""

    def __init__(self, server: SimulatedServer) -> None:
        self._server = server

    def monotonic_ns(self) -> int:
        """See `Clock`."""
        return self._server.clock.monotonic_ns()

    def time_ns(self) -> int:
        """See `Clock`."""
        return self._server.clock.time_ns()

    def sleep(self, seconds: float, /) -> None:
        """See `Clock`."""
        self._server.go_on(lambda: False, seconds)
