"""The whole server in memory: loop, recovery, jobs, hub and clients on virtual sensors, in simulated time.

    simulation = Simulation(machine=Machine(seed=3, lost=0.01))
    client = simulation.connect()
    client.ask("subscribe")
    simulation.command("power cycle 0.5")
    client.wait_event("sensor_back")
    assert client.ask("status")["sensors"][0]["recoveries"] == 1
    check_frames(simulation.frames)

Time passes while a client waits for something, and by `run`. Nothing really waits, nothing else runs: a
failure is repeated by the same arguments, step by step in a debugger.
"""

from __future__ import annotations

import functools
import json
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import pytest

from bota_ethercat.control import request
from bota_ethercat.errors import ConnectionFailedError, UnreachableError
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.settings import SettingValue, start_up_defaults
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.start_up import Wanted
from ethercat_server.acquisition.stream import Made
from ethercat_server.ethercat.bus import Bus
from ethercat_server.sensor.sensor import Identity
from ethercat_server.server import Server
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.in_memory import InMemoryStream, InMemoryTransport
from ethercat_server.serving.transport import Transport
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.measurement.signals import ClockReading, decode_clock
from ethercat_server.virtual_sensor.options import SensorOptions

PATIENCE_S = 60.0
"""Simulated time that anything may take."""
OLD = int(DataFlag.REPEATED | DataFlag.INVALID)
_EXCUSE = int(DataFlag.GAP | DataFlag.REPEATED)


class Asked:
    """What command line and configuration ask of the sensors; see `start_up.Wanted`."""

    sensor_name: str | None = None
    force = False

    def __init__(self, settings: Mapping[str, SettingValue] = {}, *, keep_unset: bool = False) -> None:
        self._settings = dict(settings)
        self.keep_unset = keep_unset

    def wanted_settings(self, _position: int, _name: str, _serial: int) -> dict[str, SettingValue]:
        return {**({} if self.keep_unset else start_up_defaults()), **self._settings}

    def asked_settings(self, _position: int, _name: str, _serial: int) -> dict[str, SettingValue]:
        return dict(self._settings)

    def check_sensors(self, found: Mapping[int, Identity]) -> None:
        pass


class RecordingHub(Hub):
    """Keeps what it hands to its clients; simulated time passes while it serves them."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(simulation.listen(), simulation.clock.monotonic_ns)
        self._simulation = simulation

    def publish(self, made: Sequence[Made], now_ns: int) -> None:
        self._simulation.note(made)
        super().publish(made, now_ns)

    def serve(self, until_ns: int) -> None:
        self._simulation.serves(until_ns, super().serve)

    def broadcast(self, message: JsonObject) -> None:
        self._simulation.events.append(message)
        super().broadcast(message)


class SimulatedBus:
    """Virtual sensors in memory."""

    near = "lo"
    """The doctor asks the kernel about it, so there must be such an interface; nothing is sent there."""

    def __init__(self, backend: MemoryBackend) -> None:
        self.backend, self.clock = backend, backend.clock

    def command(self, line: str) -> str:
        """Have a fault command of the virtual sensor obeyed now; returns its answer."""
        answer = self.backend.command(line)
        assert answer.startswith("ok"), answer
        return answer[3:]

    def at(self, seconds: float, action: str | Callable[[], object]) -> None:
        """Have a fault command obeyed, or `action` called, so many seconds from now."""
        act = functools.partial(self.command, action) if isinstance(action, str) else action
        self.clock.at(self.clock.now_ns + round(seconds * 1e9), act)

    def power_cycle(self) -> None:
        """Off, on again, and nobody looks meanwhile."""
        self.command("power cycle 0.1")
        self.clock.sleep(0.2)

    def stats(self, position: int = 0) -> dict[str, Any]:
        """What a virtual sensor says of itself."""
        found: dict[str, Any] = json.loads(self.command("stats"))["sensors"][position]
        return found

    def stats_of_foreign(self, place: int) -> dict[str, Any]:
        """What the foreign slave at this position says of itself."""
        found: dict[str, Any] = json.loads(self.command("stats"))["foreign"][str(place)]
        return found

    def written(self, position: int = 0) -> list[tuple[str, int, str]]:
        """The SDO writes so far: index, sub-index, data."""
        return [(row["index"], row["subindex"], row["hex"]) for row in self.stats(position)["sdo_writes"]]


class Simulation(SimulatedBus):
    """A server that streams. `frames` has all that it handed to its clients, `events` what it announced."""

    def __init__(
        self,
        *sensors: SensorOptions,
        machine: Machine | None = None,
        settings: Mapping[str, SettingValue] = {},
        backend: MemoryBackend | None = None,
        wanted: Wanted | None = None,
        **extra: object,
    ) -> None:
        """`backend` is that of a simulation before, for a server that is started again."""
        super().__init__(backend or MemoryBackend(*sensors, machine=machine))
        self.started_ns = self.clock.now_ns
        self.transport = InMemoryTransport(self.clock)
        self.frames: list[DataMessage] = []
        self.published_ns: list[int] = []
        """When each was handed out."""
        self.events: list[JsonObject] = []
        self._decoder = FrameDecoder()
        self._awaited: Callable[[], object] = lambda: False
        self.on_serve: Callable[[int], None] = lambda _: None
        self.hub = RecordingHub(self)
        self.bus = Bus(self.backend)
        self.server = Server(self.bus, self.hub, wanted or Asked(settings), extra=extra)
        self.sensors, self.streams, self.others = self.server.sensors, self.server.streams, self.server.others
        self.recovery, self.jobs, self.cycle = self.server.recovery, self.server.jobs, self.server.cycle
        self.clients: list[Client] = []

    def listen(self) -> Transport:
        """Where its clients come from."""
        return self.transport

    # -- what the loop hands to its clients

    def note(self, made: Sequence[Made]) -> None:
        """Keep the frames of an exchange."""
        for frame, _, _ in made:
            self._decoder.feed(frame)
            self._decoder.take_data(self.frames)
            self.published_ns.append(self.clock.now_ns)

    def serves(self, until_ns: int, serve: Callable[[int], None]) -> None:
        """Have the hub serve until then."""
        self.on_serve(until_ns)
        serve(until_ns)
        for client in self.clients:
            client.receive()
        if self._awaited():
            self.cycle.stop()

    # -- what a test does

    def connect(self, uid: int | None = 0, *, buffer_size: int = 65536) -> Client:
        """A client of user `uid`, on a framed connection."""
        return Client(self, uid, buffer_size)

    def run(self, seconds: float) -> None:
        """Let the loop run for this simulated time."""
        self.at(seconds, self.cycle.stop)
        self._run()

    def run_until(self, condition: Callable[[], object], what: str, seconds: float = PATIENCE_S) -> None:
        """Let the loop run until `condition` holds."""
        deadline_ns = self.clock.now_ns + round(seconds * 1e9)
        met = False

        def look() -> bool:
            nonlocal met
            met = bool(condition())
            return met or self.clock.now_ns >= deadline_ns

        if not condition():
            self._awaited = look
            self._run()
            self._awaited = lambda: False
            assert met or condition(), f"{what}: not within {seconds} s; events: {self.events[-6:]}"

    def go_on(self, until: Callable[[], object], seconds: float) -> None:
        """Let the loop run until something is so, for this time at most."""
        until_ns = self.clock.now_ns + round(seconds * 1e9)
        self.run_until(lambda: until() or self.clock.now_ns >= until_ns, "the end of a wait", seconds + 1)

    def _run(self) -> None:
        self.cycle.stopping = False
        self.cycle.run()

    def status(self) -> dict[str, Any]:
        return self.cycle.status()

    def close(self) -> None:
        """The server ends, as by SIGTERM: the sensors go to INIT, the clients are disconnected."""
        self.hub.close()
        self.bus.close()


class Client:
    """A framed connection that keeps everything; simulated time passes while it waits for something."""

    def __init__(self, simulation: Simulation, uid: int | None, buffer_size: int) -> None:
        self.simulation = simulation
        self.stream = simulation.transport.connect(uid, buffer_size=buffer_size)
        self.frames: list[DataMessage] = []
        self.events: list[JsonObject] = []
        """Those that `wait_event` has not returned."""
        self.replies: list[JsonObject] = []
        self.reads = True
        """Whether it takes what arrives."""
        self._decoder = FrameDecoder()
        self._id = 0
        simulation.clients.append(self)

    def receive(self) -> None:
        """Take what has arrived."""
        if not self.reads or not self.stream.readable:
            return
        self._decoder.feed(self.stream.recv_all())
        while (message := self._decoder.take_data(self.frames)) is not None:
            (self.events if "event" in message else self.replies).append(message)

    @property
    def at_end(self) -> bool:
        """Whether the server has closed the connection."""
        return self.stream.at_end

    def send(self, action: str, **keys: object) -> int:
        """Send a request; returns its id."""
        self._id += 1
        self.stream.send(encode_json(request(action, self._id, **keys)))
        return self._id

    def ask(self, action: str, **keys: object) -> dict[str, Any]:
        """The reply to a request."""
        return self.reply(self.send(action, **keys))

    def reply(self, number: int) -> dict[str, Any]:
        """Wait for the reply to the request with this id."""

        def found() -> list[JsonObject]:
            return [reply for reply in self.replies if reply.get("id") == number]

        self.simulation.run_until(found, f"the reply to request {number}")
        return found()[0]

    def wait_event(self, name: str, sensor: int = 0) -> JsonObject:
        """The first event of this name that has not been returned yet."""

        def found() -> list[JsonObject]:
            return [e for e in self.events if e["event"] == name and e.get("sensor", sensor) == sensor]

        self.simulation.run_until(found, name)
        event = found()[0]
        self.events.remove(event)
        return event

    def collect(self, count: int) -> list[DataMessage]:
        """The next `count` frames."""
        self.frames.clear()
        self.simulation.run_until(lambda: len(self.frames) >= count, f"{count} frames")
        return self.frames[:count]

    def fresh(self, count: int) -> list[DataMessage]:
        """The next `count` frames that are new and valid samples."""
        self.frames.clear()
        found: list[DataMessage] = []
        looked_at = 0

        def enough() -> bool:
            nonlocal looked_at
            found.extend(fresh(self.frames[looked_at:]))
            looked_at = len(self.frames)
            return len(found) >= count

        self.simulation.run_until(enough, f"{count} new samples")
        return found[:count]

    def close(self) -> None:
        """Disconnect."""
        self.stream.close()
        self.simulation.clients.remove(self)


class MemoryChannel:
    """A `Channel` to `server`, which may be stopped (`hangs`) and killed; time passes while its client waits.

    with StreamClient(12001, channel=MemoryChannel(server)).connect() as client: ...
    """

    is_near = True
    own = ("memory", 0)

    def __init__(self, server: Simulation, *, buffer_size: int = 65536) -> None:
        self.server: Simulation | None = server
        self.hangs = False
        self._clock, self._buffer_size = server.clock, buffer_size
        self._stream: InMemoryStream | None = None

    def kill(self) -> None:
        """The server ends without a word."""
        self.server = None
        if self._stream is not None:
            self._stream.other.close()

    def monotonic_ns(self) -> int:
        """See `Channel`."""
        now_ns: int = self._clock.monotonic_ns()
        return now_ns

    def wait(self, event: threading.Event, seconds: float, /) -> bool:
        """See `Channel`."""
        self._pass(event.is_set, seconds)
        return event.is_set()

    def connect(self, timeout_s: float) -> bool:
        """See `Channel`."""
        if self.server is None:
            raise UnreachableError("Connection refused")
        self._stream = self.server.transport.connect(0, buffer_size=self._buffer_size)
        return True

    def receive(self, buffer: memoryview, timeout_s: float) -> int:
        """See `Channel`."""
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
        """See `Channel`."""
        assert self._stream is not None
        self._stream.send(data)

    def shutdown(self) -> None:
        """See `Channel`."""
        self.close()

    def close(self) -> None:
        """See `Channel`."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def fileno(self) -> int:
        """See `Channel`."""
        return -1

    def _pass(self, until: Callable[[], object], seconds: float) -> None:
        if self.server is None or self.hangs:
            self._clock.sleep(seconds)
        elif not until():
            self.server.go_on(lambda: until() or self.hangs or self.server is None, seconds)


def more_if_long(usual: Collection[Any], every: Iterable[Any]) -> list[Any]:
    """Values of a parameter: all of `every`, those that are not in `usual` in long runs only."""
    marks = ((value, [] if value in usual else [pytest.mark.long]) for value in every)
    return [pytest.param(value, marks=mark) for value, mark in marks]


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
