"""Clients in memory, on a clock that a test advances: no sockets, no real time, the same run every time.

A test connects with `InMemoryTransport.connect` and gets the client's end of the connection. Like TCP on one
machine, each direction has a buffer of limited size, one side can be closed before the other, and closing an
end whose received bytes were not all read resets the connection. Not simulated: latency, and a peer that
disappears without closing.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Collection, Sequence
from typing import Final

from ethercat_server.ethercat.clock import Clock

_LISTENER: Final = 0
_BUFFER_SIZE: Final = 65536


class InMemoryStream:
    """One end of a connection: the server's `Stream`, or the client's end, which a test uses alike."""

    def __init__(self, number: int, peer: str, uid: int | None, buffer_size: int = _BUFFER_SIZE) -> None:
        self.peer = peer
        self.uid = uid
        self.other = self  # the other end
        self._number = number
        self._received = bytearray()
        self._buffer_size = buffer_size
        self._ended = False  # the other end sends nothing more
        self._reset = False
        self.closed = False

    def fileno(self) -> int:
        """See `Stream`."""
        return self._number

    def peer_uid(self) -> int | None:
        """See `Stream`."""
        return None if self.other.closed else self.uid

    @property
    def readable(self) -> bool:
        """Whether `recv` would not block."""
        return bool(self._received) or self._ended or self._reset

    @property
    def writable(self) -> bool:
        """Whether `send` would not block."""
        return self._reset or self.other.closed or self._room() > 0

    def recv(self, size: int, /) -> bytes:
        """See `Stream`."""
        if self._reset:
            raise ConnectionResetError
        if not self.readable:
            raise BlockingIOError
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def recv_all(self) -> bytes:
        """Everything that has arrived, b"" if nothing has."""
        return self.recv(len(self._received)) if self._received or self._reset else b""

    def send(self, data: bytes | memoryview, /) -> int:
        """See `Stream`."""
        if self._reset or self.other.closed or self.other._ended:
            raise BrokenPipeError
        if not (count := min(len(data), self._room())):
            raise BlockingIOError
        self.other._received += data[:count]
        return count

    def end_sending(self) -> None:
        """See `Stream`."""
        self.other._ended = True

    def close(self) -> None:
        """See `Stream`."""
        self.closed = True
        self.other._reset |= bool(self._received)
        self.other._ended = True

    def reset(self) -> None:
        """Close both sides; the other end finds the connection reset and what it has not read gone."""
        self.closed = self.other._reset = self.other._ended = True

    @property
    def at_end(self) -> bool:
        """Whether nothing more comes: everything until the other end closed was read, or it was reset."""
        return self._reset or (self._ended and not self._received)

    def _room(self) -> int:
        return self.other._buffer_size - len(self.other._received)


class InMemoryTransport:
    """A `Transport` whose clients are in the same process; waiting in vain advances the clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._streams: dict[int, InMemoryStream] = {}
        self._arriving: deque[InMemoryStream] = deque()
        self._ports = itertools.count(1)
        self._listens = True

    def connect(self, uid: int | None = 0, *, buffer_size: int = _BUFFER_SIZE) -> InMemoryStream:
        """The client's end of a new connection of user `uid`, with this receive buffer.

        ConnectionRefusedError once nobody listens.
        """
        if not self._listens:
            raise ConnectionRefusedError
        taken = {number for number, stream in self._streams.items() if not stream.closed}
        number = next(number for number in itertools.count(_LISTENER + 1) if number not in taken)
        server_end = InMemoryStream(number, f"memory:{next(self._ports)}", uid)
        client_end = InMemoryStream(number, "server", None, buffer_size)
        server_end.other, client_end.other = client_end, server_end
        self._streams[number] = server_end
        self._arriving.append(server_end)
        return client_end

    def listening(self) -> Sequence[int]:
        """See `Transport`."""
        return (_LISTENER,) if self._listens else ()

    def accept(self, fd: int) -> InMemoryStream | None:  # noqa: ARG002
        """See `Transport`."""
        return self._arriving.popleft() if self._arriving else None

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        """See `Transport`."""
        ready = self._ready(readers, writers)
        if ready[0] or ready[1] or seconds <= 0:
            return ready
        self._clock.sleep(seconds)
        return self._ready(readers, writers)

    def stop_listening(self) -> None:
        """See `Transport`."""
        self._listens = False
        for stream in self._arriving:
            stream.close()
        self._arriving.clear()

    def close(self) -> None:
        """See `Transport`."""
        self.stop_listening()

    def _ready(self, readers: Collection[int], writers: Collection[int]) -> tuple[list[int], list[int]]:
        readable = [number for number in readers if number != _LISTENER and self._streams[number].readable]
        if _LISTENER in readers and self._arriving:
            readable.append(_LISTENER)
        return readable, [number for number in writers if self._streams[number].writable]
