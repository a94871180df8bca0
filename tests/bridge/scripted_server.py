"""A server that does as a test tells it: speaks the wire protocol from `protocol`, knows no sensor.

It answers describe, subscribe and shutdown by itself and sends what `send_sample` and `send_raw` are given:
`MemoryServer` in memory and in simulated time, without sockets and threads, `ScriptedServer` over TCP.
"""

from __future__ import annotations

import contextlib
import math
import selectors
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol, Self

from bota_ethercat.client.channel import TcpChannel
from bota_ethercat.control import Event, event
from bota_ethercat.errors import ConnectionFailedError, ProtocolError, UnreachableError
from bota_ethercat.framing import DataMessage, FrameDecoder, encode_data, encode_json
from bota_ethercat.pdo import encode
from bota_ethercat.text.json_text import JsonObject
from tests.descriptions import description, sensor_row
from tests.server.running import wait_until

Answer = Callable[[JsonObject], JsonObject | None]


def process_data(number: float, size: int = 61) -> bytes:
    names = [f"{v}.{a}" for v in ("force", "torque", "acceleration", "angular_rate") for a in "xyz"]
    return encode(size, {name: number + i / 16 for i, name in enumerate(names)})


class Clock(Protocol):
    """What samples are dated by: the module `time`, or a simulated one."""

    def monotonic_ns(self) -> int: ...

    def time_ns(self) -> int: ...


_IN_FORCE = ("settings", "rate_hz", "delay_ms", "offset")


class Script:
    """What the server says; how is for those below."""

    def __init__(self, clock: Clock = time) -> None:
        self.clock = clock
        self.requests: list[JsonObject] = []
        self.connections = 0
        self.description = description()
        zeros = dict.fromkeys(("old_offset", "new_offset", "residual", "deviation"), [0] * 6)
        self.answers: dict[str, Answer] = {"tare": lambda _: {"ok": True, **zeros}}
        self.on_subscribe: Callable[[], None] = lambda: None
        self.subscribed = threading.Event()
        self.sequence = 0
        # How far ahead samples are dated: a node that is starved finds none too old to publish.
        self.ahead_ns = 0

    def send_raw(self, data: bytes) -> None:
        raise NotImplementedError

    def send_json(self, message: JsonObject) -> None:
        """An event changes what it describes, as a server's does."""
        for row in self.description["sensors"] if "event" in message else ():
            if row["sensor"] == message.get("sensor"):
                row |= {key: message[key] for key in _IN_FORCE if key in message}
        self.send_raw(encode_json(message))

    def send_sample(self, number: float, flags: int = 0, **changes: Any) -> None:
        self.send_raw(self.frame(number, flags, **changes))

    def frame(self, number: float, flags: int = 0, **changes: Any) -> bytes:
        self.sequence += 1
        moment = self.clock.monotonic_ns() + self.ahead_ns
        message = DataMessage(self.sequence, self.clock.time_ns(), moment, 0, flags, 3, process_data(number))
        return encode_data(*message._replace(**changes))

    def receive(self, decoder: FrameDecoder, data: bytes) -> None:
        decoder.feed(data)
        for message in decoder:
            assert isinstance(message, dict)
            self.requests.append(message)
            self._answer(message)

    def _answer(self, message: JsonObject) -> None:
        action = str(message["action"])
        reply: JsonObject | None = {"ok": True}
        if action in {"describe", "subscribe"}:
            reply = {"ok": True, **self.description}
        if action in self.answers:
            reply = self.answers[action](message)
        if reply is not None:
            self.send_json({"reply": action, "id": message.get("id"), **reply})
        if action == "subscribe" and reply is not None and reply["ok"]:
            self.on_subscribe()
            self.subscribed.set()


class MemoryServer(Script):
    """What it sends has arrived at once; `Client(1, channel=ScriptedChannel(server))` is its client."""

    def __init__(self) -> None:
        super().__init__(self)
        self.now_ns = 10**15
        self.listens = self.is_connected = True
        self.is_there = True  # its computer answers; else connecting is pending for ever
        self.attempted_s: list[float] = []
        self.arrived = bytearray()
        self._agenda: list[tuple[int, Callable[[], object]]] = []

    def at(self, now_ns: int, action: Callable[[], object]) -> None:
        self._agenda.append((now_ns, action))

    def go_on(self, seconds: float) -> None:
        until_ns = self.now_ns + math.ceil(seconds * 1e9)
        while not self.arrived and self._agenda and self._agenda[0][0] <= until_ns:
            self.now_ns, action = self._agenda.pop(0)
            action()
        if not self.arrived:
            self.now_ns = until_ns

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self.now_ns += math.ceil(max(seconds, 0.0) * 1e9)
        return event.is_set()

    def monotonic(self) -> float:
        return self.now_ns / 1e9

    def monotonic_ns(self) -> int:
        return self.now_ns

    def time_ns(self) -> int:
        return self.now_ns

    def send_raw(self, data: bytes) -> None:
        self.arrived += data

    def drop(self) -> None:
        self.subscribed.clear()
        self.is_connected = False


class ScriptedChannel(TcpChannel):
    """The channel to it. Time passes while the client waits."""

    def __init__(self, server: MemoryServer) -> None:
        super().__init__("memory", 0)
        self.same_address, self.monotonic_ns = True, server.monotonic_ns
        self._server = server
        self._requests = FrameDecoder()

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return self._server.wait(event, seconds)

    def connect(self, timeout_s: float) -> bool:
        self._server.attempted_s.append(self._server.monotonic())
        if not self._server.is_there:
            self.wait(threading.Event(), timeout_s)
            return False
        if not self._server.listens:
            raise UnreachableError("Connection refused")
        self._server.connections += 1
        self._server.is_connected, self._requests = True, FrameDecoder()
        return True

    def receive(self, buffer: bytearray | memoryview, timeout_s: float) -> int:
        arrived = self._server.arrived
        if not arrived and not self._server.is_connected:
            raise ConnectionFailedError("the server closed it")
        self._server.go_on(timeout_s)
        count = min(len(buffer), len(arrived))
        buffer[:count] = arrived[:count]
        del arrived[:count]
        return count

    def send(self, data: bytes) -> None:
        if not self._server.is_connected:
            raise ConnectionFailedError("cannot send: Broken pipe")
        self._server.receive(self._requests, data)

    def shutdown(self) -> None:
        self._server.drop()

    def close(self) -> None:
        self._server.drop()
        self._server.arrived.clear()

    def fileno(self) -> int:
        return -1


class ScriptedServer(Script):
    """Listens on a port of the loopback, by default a free one; samples go to the newest subscriber."""

    def __init__(self, port: int = 0, **sensor: Any) -> None:
        super().__init__()
        self.description = description(sensor_row(**sensor))
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self.disconnected = threading.Event()
        self.streams: list[socket.socket] = []  # subscribers, the newest last
        self._peers: dict[int, socket.socket] = {}  # by descriptor
        self._selector = selectors.DefaultSelector()
        self._asking: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, name="scripted server", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._closing = True
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self.drop()
        self._thread.join(5)
        self._listener.close()

    def drop(self) -> None:
        self.subscribed.clear()
        for peer in list(self._peers.values()):
            with contextlib.suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)

    def send_raw(self, data: bytes) -> None:
        answers = threading.current_thread() is self._thread or not self.streams
        peer = self._asking if answers else self.streams[-1]
        assert peer is not None
        peer.sendall(data)

    def send(self, *messages: bytes | JsonObject) -> None:
        wait_until(lambda: bool(self.streams), "a subscriber")
        for message in messages:
            self.send_raw(message) if isinstance(message, bytes) else self.send_json(message)

    def reconfigure(self, **sensor: Any) -> None:
        row = sensor_row(**sensor)
        self.description["sensors"] = [row]
        self.send(event(Event.RECONFIGURED, sensor=0, settings=row["settings"], rate_hz=row["rate_hz"]))

    def _answer(self, message: JsonObject) -> None:
        if message["action"] == "subscribe" and self._asking is not None:
            self.streams.append(self._asking)
        super()._answer(message)

    def _serve(self) -> None:
        self._selector.register(self._listener, selectors.EVENT_READ)
        while True:
            for ready, _ in self._selector.select():
                if isinstance(ready.data, FrameDecoder):
                    self._read(self._peers[ready.fd], ready.data)
                    continue
                try:
                    self._asking, _ = self._listener.accept()
                except OSError:  # it is closed
                    for peer in list(self._peers.values()):
                        self._end(peer)
                    self._selector.close()
                    return
                self.connections += 1
                self._peers[self._asking.fileno()] = self._asking
                self._selector.register(self._asking, selectors.EVENT_READ, FrameDecoder())

    def _read(self, peer: socket.socket, decoder: FrameDecoder) -> None:
        self._asking = peer
        try:
            if not (data := peer.recv(65536)):
                raise ConnectionResetError
            self.receive(decoder, data)
        except (OSError, ProtocolError):
            self._end(peer)

    def _end(self, peer: socket.socket) -> None:
        self._selector.unregister(peer)
        del self._peers[peer.fileno()]
        if peer in self.streams:
            self.streams.remove(peer)
        peer.close()
        self.subscribed.clear()
        self.disconnected.set()
