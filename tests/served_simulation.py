"""The whole server in a thread of this process: real sockets, virtual sensors in memory.

    with served(sinc_length=512) as server, connect(server.port) as client:
        server.command("power cycle 0.5")

For clients, which cannot tell it from `ethercat-server virtual`. Its time follows CLOCK_MONOTONIC, and falls
behind where the machine is busy: then samples come late, but no sensor is starved and none is lost.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future

from bota_ethercat.control import Event, event
from bota_ethercat.settings import SettingValue
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.serving.transport import SocketTransport, Transport
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine, SimulatedClock
from ethercat_server.virtual_sensor import bus as virtual
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.running import PATIENCE_S, Client, free_port
from tests.simulation import USUAL, Simulation


class _Backend(MemoryBackend):
    """Its clock shows what CLOCK_MONOTONIC shows."""

    def __init__(self, *sensors: SensorOptions) -> None:
        super().__init__(*sensors)
        self.clock = SimulatedClock(Machine(), time.monotonic_ns())
        self.sensors = virtual.SlaveChain(sensors or (USUAL,), self.clock.now_ns)


class _Transport(SocketTransport):
    """While it waits for the sockets, simulated time passes as it does outside."""

    def __init__(self, clock: SimulatedClock, port: int) -> None:
        super().__init__(["127.0.0.1", "::1"], port)
        self._clock = clock

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        began_ns, until_ns = time.monotonic_ns(), self._clock.now_ns + round(seconds * 1e9)
        ready = super().wait(readers, writers, max(0, until_ns - began_ns) * 1e-9)
        if any(ready):  # it does not catch up now: it would always be too late to begin a request
            until_ns = min(until_ns, self._clock.now_ns + time.monotonic_ns() - began_ns)
        self._clock.advance(until_ns)
        return ready


class ServedSimulation(Simulation):
    """A server that streams on `port` until `close`."""

    def __init__(self, *sensors: SensorOptions, settings: Mapping[str, SettingValue], port: int = 0) -> None:
        self.port = port or free_port()
        self._todo = queue.SimpleQueue[Callable[[], None]]()
        super().__init__(*sensors, settings=settings, backend=_Backend(*sensors))
        self._thread = threading.Thread(target=self.cycle.run, name="server")
        self._thread.start()

    def listen(self) -> Transport:
        return _Transport(self.clock, self.port)

    def note(self, made: Sequence[OutgoingFrame]) -> None:
        """Nothing is kept: it may run for long."""

    def serves(self, until_ns: int, serve: Callable[[int], int]) -> None:
        while not self._todo.empty():
            self._todo.get()()
        super().serves(until_ns, serve)

    def command(self, line: str) -> str:
        """As that of `Simulation`, from another thread."""
        answer = Future[str]()
        self._todo.put(lambda: answer.set_result(self.backend.command(line)))
        said = answer.result(PATIENCE_S)
        assert said.startswith("ok"), said
        return said[3:]

    def close(self) -> None:
        """As by SIGTERM; nothing more once it has ended."""
        self._end()
        self.hub.broadcast(event(Event.SHUTTING_DOWN))
        super().close()

    def kill(self) -> None:
        """As by SIGKILL: its connections end without a word."""
        self._end()
        for connection in self.hub.connections.values():
            connection.close()
        self.hub.connections.clear()
        self.hub.close()

    def _end(self) -> None:
        self.cycle.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    def client(self) -> Client:
        return Client(self.port)


@contextlib.contextmanager
def served(*sensors: SensorOptions, port: int = 0, **settings: SettingValue) -> Iterator[ServedSimulation]:
    """A server that streams these sensors, by default one, until the end of the block."""
    server = ServedSimulation(*sensors, settings=settings, port=port)
    try:
        yield server
    finally:
        server.close()
