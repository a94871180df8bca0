"""A `Channel` to a server in memory: time passes while its client waits.

server = Simulation()
with Client(12001, channel=MemoryChannel(server)).connect() as client: ...
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

from ethercat_server.serving.transport.in_memory import InMemoryStream, InMemoryTransport
from protocol.errors import ConnectionFailedError, UnreachableError


class Clock(Protocol):
    def monotonic_ns(self) -> int: ...

    def sleep(self, seconds: float, /) -> None: ...


class Server(Protocol):
    """A `Simulation`, or a server on a `SimulatedBus`."""

    @property
    def clock(self) -> Any: ...

    @property
    def transport(self) -> InMemoryTransport: ...

    def go_on(self, until: Callable[[], object], seconds: float) -> None:
        """Run until something is so, `seconds` at most."""


class MemoryChannel:
    """To `server`, which may be stopped (`hangs`) and killed."""

    is_near = True
    own = ("memory", 0)

    def __init__(self, server: Server, *, buffer_size: int = 65536) -> None:
        self.server: Server | None = server
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
