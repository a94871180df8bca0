"""A `Channel` to a simulated server: time passes while its client waits.

    server = Simulation()
    with Client(12001, channel=MemoryChannel(server)).connect() as client: ...
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from ethercat_server.serving.transport.in_memory import InMemoryStream
from protocol.errors import ConnectionFailedError, UnreachableError
from tests.simulation import Simulation


class MemoryChannel:
    """To `server`, which may be stopped (`hangs`), killed and started again (`kill`, `server`)."""

    is_near = True

    def __init__(self, server: Simulation) -> None:
        self.server: Simulation | None = server
        self.hangs = False
        self._clock = server.clock
        self._stream: InMemoryStream | None = None

    def kill(self) -> None:
        """The server ends without a word."""
        self.server = None
        if self._stream is not None:
            self._stream.other.close()

    def monotonic_ns(self) -> int:
        """See `Channel`."""
        return self._clock.now_ns

    def wait(self, event: threading.Event, seconds: float, /) -> bool:
        """See `Channel`."""
        self._pass(event.is_set, seconds)
        return event.is_set()

    def connect(self, timeout_s: float) -> bool:
        """See `Channel`."""
        if self.server is None:
            raise UnreachableError("Connection refused")
        self._stream = self.server.transport.connect(0)
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
        """Let time pass until something is so, `seconds` at most."""
        server, until_ns = self.server, self._clock.now_ns + round(seconds * 1e9)
        if server is None or self.hangs:
            self._clock.sleep(seconds)
        elif not until():
            server.run_until(
                lambda: until() or self.hangs or self.server is None or self._clock.now_ns >= until_ns,
                "the end of the wait", seconds + 1,
            )  # fmt: skip
