"""A scripted server in memory and in simulated time, and the channel to it: no sockets, no threads."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from bota_ethercat.client.channel import TcpChannel
from bota_ethercat.errors import ConnectionFailedError, UnreachableError
from bota_ethercat.framing import FrameDecoder
from tests.bridge.scripted_server import Script


class MemoryServer(Script):
    """What it sends has arrived at once; `Client(1, channel=ScriptedChannel(server))` is its client."""

    def __init__(self) -> None:
        super().__init__(self)
        self.now_ns = 10**15
        self.listens = self.is_connected = True
        self.is_there = True  # its computer answers; else connecting is pending for ever
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

    def monotonic_ns(self) -> int:
        return self.now_ns

    time_ns = monotonic_ns

    def send_raw(self, data: bytes) -> None:
        self.arrived += data

    def drop(self) -> None:
        self.is_connected = False


class ScriptedChannel(TcpChannel):
    """The channel to it. Time passes while the client waits."""

    def __init__(self, server: MemoryServer) -> None:
        super().__init__("memory", 0)
        self.same_address, self.monotonic_ns = True, server.monotonic_ns
        self._server = server
        self._requests = FrameDecoder()

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self._server.now_ns += math.ceil(max(seconds, 0.0) * 1e9)
        return event.is_set()

    def connect(self, timeout_s: float) -> bool:
        if not self._server.is_there:
            self.wait(threading.Event(), timeout_s)
            return False
        if not self._server.listens:
            raise UnreachableError("Connection refused")
        self._server.connections += 1
        self._server.is_connected, self._requests = True, FrameDecoder()
        return True

    def receive(self, buffer: memoryview, timeout_s: float) -> int:
        arrived = self._server.arrived
        if not arrived and not self._server.is_connected:
            raise ConnectionFailedError("the server closed it")
        self._server.go_on(timeout_s)
        count = min(len(buffer), len(arrived))
        buffer[:count] = arrived[:count]
        del arrived[:count]
        return count

    def send(self, data: bytes) -> None:
        self._server.receive(self._requests, data)

    def shutdown(self) -> None:
        self._server.drop()

    def close(self) -> None:
        self._server.drop()
        self._server.arrived.clear()

    def fileno(self) -> int:
        return -1
