"""The whole server in memory: loop, recovery, jobs, hub and clients on virtual sensors, in simulated time.

    simulation = Simulation(machine=Machine(seed=3, lost=0.01))
    with Client(12001, channel=MemoryChannel(simulation)).connect() as sensor:
        simulation.command("power cycle 0.5")
        reading = sensor.latest(timeout_s=2.0)

Time passes while a client waits for something, and by `run`. Nothing really waits, nothing else runs: a
failure is repeated by the same arguments, step by step in a debugger.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from bota_ethercat.client.channel import TcpChannel
from bota_ethercat.errors import ConnectionFailedError, UnreachableError
from bota_ethercat.settings import SettingValue
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.start_up import Wanted
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.daemon.options import ServerOptions
from ethercat_server.ethercat.bus import Bus
from ethercat_server.server import Server
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.transport import Transport
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine
from ethercat_server.simulation.transport import InMemoryStream, InMemoryTransport
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.signals import World
from ethercat_server.virtual_sensor.world import ExternalWorld


class _Hub(Hub):
    """Tells the simulation what it does; simulated time passes while it serves."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation.listen(), simulation.clock.raw_ns)
        self._simulation = simulation

    def publish(self, made: Sequence[OutgoingFrame], now_ns: int) -> None:
        self._simulation.note(made)
        super().publish(made, now_ns)
        self._simulation.look()

    def serve(self, until_ns: int) -> int:
        self._simulation.serves(until_ns, super().serve)
        return self._simulation.clock.now_ns

    def broadcast(self, message: JsonObject) -> None:
        self._simulation.events.append(message)
        super().broadcast(message)


class SimulatedBus:
    """Virtual sensors in memory: `backend` has sensors, wire and machine, `clock` the simulated time."""

    def __init__(self, backend: MemoryBackend) -> None:
        self.backend, self.clock = backend, backend.clock

    def command(self, line: str) -> str:
        """Do what a fault command of the virtual sensor says, now; returns its answer."""
        answer = self.backend.command(line)
        if not answer.startswith("ok"):
            raise ValueError(answer)
        return answer[3:]

    def at(self, seconds: float, action: str | Callable[[], object]) -> None:
        """Have a fault command obeyed, or `action` called, this time from now."""
        act = functools.partial(self.command, action) if isinstance(action, str) else action
        self.clock.at(self.clock.now_ns + round(seconds * 1e9), act)


class Simulation(SimulatedBus):
    """A server that streams.

    Attributes:
        server: the server itself.
        events: what it announced.
        hangs: whether it is stopped, as by SIGSTOP; time passes all the same.
    """

    def __init__(
        self,
        *sensors: SensorOptions,
        machine: Machine | None = None,
        settings: Mapping[str, SettingValue] = {},
        backend: MemoryBackend | None = None,
        wanted: Wanted | None = None,
        world: World | None = None,
        **extra: object,
    ) -> None:
        """Start it; ServerError as of `Server`, which `extra` is for, too.

        Args:
            sensors: by default one.
            machine: how late it wakes, what it does to frames.
            settings: of all sensors.
            backend: that of a simulation before, for a server that is started again.
            wanted: instead of the settings.
            world: what the sensors feel; asked once a millisecond, with the simulated time, s.
        """
        external = ExternalWorld()
        if world is not None:
            sensors = tuple(replace(each, world=external) for each in sensors or (SensorOptions(),))
        super().__init__(backend or MemoryBackend(*sensors, machine=machine))
        self.started_ns, self.hangs = self.clock.now_ns, False
        if world is not None:
            self._ask(world, external, 0)
        self.transport = InMemoryTransport(self.clock)
        self.events: list[JsonObject] = []
        self._awaited: Callable[[], object] = lambda: False
        self._until_ns = 0
        self.hub, self.bus = _Hub(self), Bus(self.backend)
        options = wanted or ServerOptions(self.backend.ifname, 0, assigned=settings)
        self.server = Server(self.bus, self.hub, options, extra=extra)
        self.cycle = self.server.cycle

    def _ask(self, world: World, external: ExternalWorld, step: int) -> None:
        """Tell the sensors what they feel in this millisecond, and in the following."""
        due_ns = self.started_ns + step * 1_000_000
        external.update(due_ns * 1e-9, world(step * 1e-3), due_ns * 1e-9)
        self.clock.at(due_ns + 1_000_000, functools.partial(self._ask, world, external, step + 1))

    def run(self, seconds: float) -> None:
        """Let the loop run for this simulated time."""
        self.go_on(lambda: False, seconds)

    def go_on(self, until: Callable[[], object], seconds: float) -> None:
        """Let the loop run until something is so, for this time at most; not where it hangs."""
        if self.hangs:
            self.clock.sleep(seconds)
        elif not until():
            self._until_ns = until_ns = self.clock.now_ns + round(seconds * 1e9)
            self._awaited = lambda: until() or self.clock.now_ns >= until_ns
            self.cycle.stopping = False
            self.cycle.run()
            self._awaited = lambda: False

    def status(self) -> dict[str, Any]:
        """What the server's `status` replies of itself."""
        return self.cycle.status()

    def close(self) -> None:
        """The server ends, as by SIGTERM: the sensors go to INIT, the clients are disconnected."""
        # Else nothing is served, and simulated time stands still while a client does not take what it gets.
        self.cycle.stopping, self._until_ns = False, 1 << 63
        self.hub.close()
        self.bus.close()

    # -- to be overridden

    def listen(self) -> Transport:
        """Where its clients come from."""
        return self.transport

    def note(self, made: Sequence[OutgoingFrame]) -> None:
        """See the frames of an exchange."""

    def serves(self, until_ns: int, serve: Callable[[int], int]) -> None:
        """Have the hub serve until then, or until the time that somebody waits for."""
        if not self.cycle.stopping:
            serve(min(until_ns, self._until_ns))
            self.look()

    def look(self) -> None:
        """Have the loop end if what somebody waits for is there."""
        if self._awaited():
            self.cycle.stop()


class MemoryChannel(TcpChannel):
    """The channel of a `bota_ethercat.client.Client` to a simulation; time passes while the client waits."""

    def __init__(self, server: Simulation) -> None:
        super().__init__("memory", 0)
        self.same_address, self.monotonic_ns = True, server.clock.monotonic_ns
        self.server: Simulation | None = server
        self._clock = server.clock
        self._stream: InMemoryStream | None = None

    def kill(self) -> None:
        """The server ends without a word."""
        self.server = None
        if self._stream is not None:
            self._stream.other.end_sending()  # it may be just running, and must not find it closed

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self._pass(event.is_set, seconds)
        return event.is_set()

    def connect(self, _timeout_s: float) -> bool:
        if self.server is None:
            raise UnreachableError("Connection refused")
        self._stream = self.server.transport.connect(0, buffer_size=1 << 20)
        return True

    def receive(self, buffer: bytearray | memoryview, timeout_s: float) -> int:
        stream = self._stream
        if stream is None:
            raise ConnectionFailedError("Bad file descriptor")
        if timeout_s > 0:
            self._pass(lambda: stream.readable, timeout_s)
        if stream.at_end:
            raise ConnectionFailedError("the server closed it")
        if not stream.readable:
            return 0
        data = stream.recv(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def send(self, data: bytes) -> None:
        assert self._stream is not None
        self._stream.send(data)

    def shutdown(self) -> None:
        self.close()

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def fileno(self) -> int:
        return -1

    def _pass(self, until: Callable[[], object], seconds: float) -> None:
        if self.server is None:
            self._clock.sleep(seconds)
        elif not until():
            self.server.go_on(lambda: until() or self.server is None or self.server.hangs, seconds)
