"""`ethercat_server.simulation`, with clients that tests use.

    simulation = Simulation(machine=Machine(seed=3, lost=0.01))
    client = simulation.connect()
    client.ask("subscribe")
    simulation.command("power cycle 0.5")
    client.wait_event("sensor_back")
    assert client.ask("status")["sensors"][0]["recoveries"] == 1
    check_frames(simulation.frames)

For the tool and the doctor: within `simulated_bus` whatever opens an interface gets these virtual sensors;
within `simulated_server` whatever connects to a server gets one that streams them.

    with simulated_bus("--serial", "10,20") as bus:
        bus.command("power cycle 0.5")
        result = run_here(main, "apply", "--dry-run", bus.near, "--set", "fir=on")
        assert bus.written(1) == []
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import pytest

from bota_ethercat import client as blocking
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder
from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.settings import SettingValue
from ethercat_server.access import private_server, sensors
from ethercat_server.access.sensors import Sensors
from ethercat_server.acquisition.start_up import AsFound, Wanted
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.daemon.options import DEFAULTS, KEEP, ServerOptions
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import ByPosition
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.sii import read_sii
from ethercat_server.process import realtime
from ethercat_server.sensor import scan
from ethercat_server.simulation import server
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine
from ethercat_server.simulation.server import MemoryChannel
from ethercat_server.virtual_sensor.cli import build_parser, options_from
from ethercat_server.virtual_sensor.options import SensorOptions, parse_chain, slaves_in
from ethercat_server.virtual_sensor.sensor import Firmware
from scripts.benchmarks.records import ClockReading, decode_clock
from tests.server.running import OLD, Commanded, FramedClient

PATIENCE_S = 60.0  # simulated time that anything may take
AT_REST = SensorOptions(signal="rest", last_bit=False)
USUAL = SensorOptions(signal="rest")  # it costs half of `scene`
_EXCUSE = int(DataFlag.GAP | DataFlag.REPEATED)


class ManualClock:
    """A clock that stands still until it is advanced."""

    def __init__(self, now_ns: int = 1_000_000_000) -> None:
        self.now_ns = now_ns

    def raw_ns(self) -> int:
        return self.now_ns

    monotonic_ns = raw_ns

    def time_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float, /) -> None:
        self.now_ns += round(seconds * 1e9)


def asked(
    settings: Mapping[str, SettingValue] = {}, *, keep_unset: bool = False, terminals: Sequence[str] = ()
) -> ServerOptions:
    """What command line and configuration ask of the sensors."""
    unset = KEEP if keep_unset else DEFAULTS
    return ServerOptions(
        "memory", 0, server={"unset_settings": unset, "terminals": terminals}, assigned=settings
    )


def life_of(backend: MemoryBackend, number: int = 0) -> Firmware:
    """The firmware of a sensor that has power."""
    life = backend.sensors.sensors[number].life
    assert life is not None
    return life


def chain(text: str) -> MemoryBackend:
    """A bus with these slaves."""
    return MemoryBackend(*slaves_in(parse_chain(text)))


def registers(backend: MemoryBackend) -> list[bytes]:
    """All registers of every slave."""
    lives = [slave.life for slave in backend.sensors.slaves]
    return [bytes(life.esc.memory[: reg.REGISTERS_END]) for life in lives if life is not None]


class SimulatedBus(server.SimulatedBus, Commanded):
    """Virtual sensors in memory."""

    # The doctor asks the kernel about it, so there must be such an interface; nothing is sent there.
    near = "lo"

    def power_cycle(self) -> None:
        """Off, on again, and nobody looks meanwhile."""
        self.command("power cycle 0.1")
        self.clock.sleep(0.2)


class Exchange:
    """Sends the process data of `bus`, and waits for it."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.inputs: dict[int, bytes] = {}  # of each sensor, as of the last exchange that came back

    def __call__(self, timeout_s: float = 0.01) -> int:
        """The working counter of all frames; -1 if one did not come back in time."""
        process_data, clock = self.bus.process_data, self.bus.clock
        until_ns = clock.raw_ns() + round(timeout_s * 1e9)
        began_ns, awaited, total = clock.raw_ns(), len(process_data.inputs), 0
        process_data.send()
        while awaited:
            left_ns = until_ns - clock.raw_ns()
            if left_ns <= 0 or (frame := self.bus.backend.receive(left_ns * 1e-9)) is None:
                return -1
            answer = process_data.match(frame, clock.raw_ns())
            if answer is not None and answer.sent_ns > began_ns:
                awaited -= 1
                total += answer.wkc
                for at in process_data.inputs[answer.which]:
                    self.inputs[at.number] = frame[at.start : at.end]
        return total


class Simulation(server.Simulation, SimulatedBus):
    """A server that streams. `frames` has all that it handed to its clients."""

    def __init__(self, *sensors: SensorOptions, **more: Any) -> None:
        """With a `machine` or a `backend` of the test's the server reads all of the SII at its start."""
        self.frames: list[DataMessage] = []
        self.published_ns: list[int] = []  # when each was handed out
        self._decoder = FrameDecoder()
        self.on_serve: Callable[[int], None] = lambda _: None
        self.clients: list[Client] = []
        if not sensors and "world" not in more:
            sensors = (USUAL,)
        with pytest.MonkeyPatch.context() as patch:
            if more.get("backend") is None and more.get("machine") is None:
                patch.setattr(scan, "read_image", _read_image)
            super().__init__(*sensors, **more)
        self.sensors, self.streams, self.others = self.server.sensors, self.server.streams, self.server.others
        self.recovery, self.jobs = self.server.recovery, self.server.jobs

    def note(self, made: Sequence[OutgoingFrame]) -> None:
        """Keep the frames of an exchange."""
        for frame, *_ in made:
            self._decoder.feed(frame)
            self._decoder.next_data(self.frames)
            self.published_ns.append(self.clock.now_ns)

    def serves(self, until_ns: int, serve: Callable[[int], int]) -> None:
        if not self.cycle.stopping:
            self.on_serve(until_ns)
        super().serves(until_ns, serve)

    def look(self) -> None:
        """Have the clients take what has arrived, too."""
        for client in self.clients:
            client.receive()
        super().look()

    def connect(self, uid: int | None = 0, *, buffer_size: int = 65536) -> Client:
        """A client of user `uid`, on a framed connection."""
        return Client(self, uid, buffer_size)

    def subscribe(self, uid: int | None = 0, *, buffer_size: int = 65536, **keys: object) -> Client:
        """A client that has subscribed."""
        client = self.connect(uid, buffer_size=buffer_size)
        assert client.ask("subscribe", **keys)["ok"]
        return client

    def run_until(self, condition: Callable[[], object], what: str, seconds: float = PATIENCE_S) -> None:
        """Let the loop run until `condition` holds."""
        met = False

        def is_met() -> bool:
            nonlocal met
            met = bool(condition())
            return met

        self.go_on(is_met, seconds)
        assert met or condition(), f"{what}: not within {seconds} s; events: {self.events[-6:]}"


class Client(FramedClient):
    """One in memory; simulated time passes while it waits for something."""

    def __init__(self, simulation: Simulation, uid: int | None, buffer_size: int) -> None:
        self.simulation = simulation
        self.stream = simulation.transport.connect(uid, buffer_size=buffer_size)
        super().__init__(self.stream.send, simulation.run_until)
        self.reads = True  # whether it takes what arrives
        simulation.clients.append(self)

    def receive(self) -> None:
        """Take what has arrived."""
        if not self.reads or not self.stream.readable:
            return
        self._decoder.feed(self.stream.recv_all())
        while (message := self._decoder.next_data(self.frames)) is not None:
            self.keep(message)

    @property
    def at_end(self) -> bool:
        """Whether the server has closed the connection."""
        return self.stream.at_end

    def close(self) -> None:
        """Disconnect."""
        self.stream.close()
        self.simulation.clients.remove(self)


class Bench(Simulation):
    """A server, by default on a stationary sensor, with a client that listens and one that asks."""

    def __init__(self, *sensors: SensorOptions, **more: Any) -> None:
        super().__init__(*(sensors or (AT_REST,)), **more)
        self.listener, self.asking = self.subscribe(), self.connect()
        self.ask, self.refused, self.described = self.asking.ask, self.asking.refused, self.asking.described
        self.listener.fresh(50)

    def start_again(self, **more: Any) -> Bench:
        """End this server and start another one on the same sensors; see `Simulation`."""
        self.close()
        return Bench(backend=self.backend, **more)


def more_if_long(usual: Collection[Any], every: Iterable[Any]) -> list[Any]:
    """Values of parameters: all of `every`, those that are not in `usual` in long runs only."""
    every = [*every]
    assert all(value in every for value in usual), "a usual one would never be run"
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=[] if value in usual else [pytest.mark.long],
        )
        for value in every
    ]


def fresh(frames: Iterable[DataMessage]) -> list[DataMessage]:
    """Those that carry a new sample."""
    return [frame for frame in frames if not frame.flags & OLD]


def reading(frame: DataMessage) -> ClockReading:
    """The number and the instant that a sensor with the signal `clock` wrote into its sample."""
    return decode_clock(LAYOUTS[len(frame.process_data)].struct.unpack(frame.process_data)[2:8])


def check_frames(frames: Iterable[DataMessage], *, complete: bool = True) -> None:
    """What holds for one sensor's frames in every run, whatever happened; its signal has to be `clock`.

    Nothing comes twice, nothing out of order, no old sample as a new one. `complete` if all frames that the
    server made are there: then they are numbered without a gap, and what is missing is flagged.
    """
    last: DataMessage | None = None
    new: DataMessage | None = None
    visible, unflagged, count = True, 0, 0
    for frame in frames:
        if last is not None:
            assert frame.sequence > last.sequence, "numbered through"
            assert not complete or frame.sequence == last.sequence + 1
            if frame.flags & OLD and complete:
                assert frame.process_data == last.process_data, "it has nothing new to say"
        # A sensor that gives the same data again for a while was watched: nothing was lost on the way.
        visible |= bool(frame.flags & _EXCUSE)
        last = frame
        if frame.flags & OLD:
            continue
        if new is not None:
            before, after = reading(new), reading(frame)
            assert after.instant_ns > before.instant_ns, "an old sample as a new one"
            assert frame.monotonic_ns > new.monotonic_ns
            unflagged += after.number != before.number + 1 and not visible
        new, visible, count = frame, False, count + 1
    assert unflagged == 0, f"{unflagged} of {count} follow a loss without a flag"


# -- the buses of the tool and the doctor

# What a server sets the sensors to: the fewer samples, the faster it is simulated.
SINC_LENGTH, RATE_HZ = 512, 100
_READ_IMAGE = scan.read_image


def _read_image(bus: Bus, position: int, check_interrupt: CheckInterrupt = lambda: None) -> bytes:
    """The SII, on which most of a start would be spent; nothing else reads it like this."""
    bus.finish(read_sii(ByPosition(bus), position, 0, 4))
    assert isinstance(bus.backend, MemoryBackend)
    life = bus.backend.sensors.slaves[position].life
    return _READ_IMAGE(bus, position, check_interrupt) if life is None else life.esc.sii.image


@contextlib.contextmanager
def simulated_bus(*arguments: object, machine: Machine | None = None) -> Iterator[SimulatedBus]:
    """Sensors as `ethercat-virtual-sensor IFACE --signal rest arguments...` simulates.

    Nobody writes their calibration.
    """
    slaves = options_from(build_parser().parse_args(["lo", "--signal", "rest", *map(str, arguments)]))
    bus = SimulatedBus(MemoryBackend(*slaves, machine=machine))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan, "read_image", _read_image)
        patch.setattr(private_server, "open_bus", lambda _ifname, **_: contextlib.closing(Bus(bus.backend)))

        def private(_ifname: str, *, force: bool = False, **_: object) -> PrivateServer:
            server = PrivateServer(bus, AsFound(force=force))
            patch.setattr(Sensors, "clock", server)
            return server

        patch.setattr(sensors, "PrivateServer", private)
        patch.setattr(realtime, "prepare", lambda _priority, _cpu: None)
        yield bus
    numbers = range(len(bus.backend.sensors.sensors))
    assert not any(bus.stats(position)["calibration_writes"] for position in numbers)


class SimulatedServer(Simulation):
    """A server that streams the sensors of a bus, while somebody waits for something from it.

    It is the clock of its clients, too: while one sleeps, the server goes on.
    """

    address = "localhost:12001"

    def __init__(self, bus: SimulatedBus, wanted: Wanted | None = None) -> None:
        # Here a message comes a period late, because time passes while the server serves: ages mean nothing.
        super().__init__(
            backend=bus.backend, settings={"sinc_length": SINC_LENGTH}, wanted=wanted, boot_id="simulated"
        )

    def monotonic_ns(self) -> int:
        return self.clock.monotonic_ns()

    def time_ns(self) -> int:
        return self.clock.time_ns()

    def sleep(self, seconds: float, /) -> None:
        self.go_on(lambda: False, seconds)

    def client(self) -> blocking.Client:
        """A client for this test's own requests."""
        return blocking.Client(12001, stream=False, channel=MemoryChannel(self)).connect()


class PrivateServer(SimulatedServer):
    """One that a program has for itself."""

    error = None
    real_time = True

    def __init__(self, bus: SimulatedBus, wanted: Wanted) -> None:
        super().__init__(bus, wanted)
        self.channel = MemoryChannel(self)

    def interrupt(self) -> None:
        self.server.jobs.interrupt(private_server.STOPPED)


@contextlib.contextmanager
def simulated_server(bus: SimulatedBus) -> Iterator[SimulatedServer]:
    """A server that streams from `bus`, behind every address."""
    server = SimulatedServer(bus)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bota_ethercat.client.client.TcpChannel", lambda *_: MemoryChannel(server))
        patch.setattr(Sensors, "clock", server)
        yield server
