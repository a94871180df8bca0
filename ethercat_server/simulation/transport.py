"""Clients in memory, on a clock that a test advances: no sockets, no real time, the same run every time.

A test connects with `InMemoryTransport.connect` and gets the client's end of the connection. What sockets of
one machine do is compared call by call in tests/server/test_transport.py: order of descriptors, buffers of
limited size, halves that are closed one by one, resets, and the errors of all that. Not simulated: latency,
the length of a listener's queue, a peer that disappears without closing, waking up before the time is over.
"""

from __future__ import annotations

import errno
import itertools
import os
from collections import deque
from collections.abc import Collection, Sequence
from typing import Final

from ethercat_server.ethercat.clock import Clock

_LISTENERS: Final = 2  # as the server's: 127.0.0.1 and ::1
_BUFFER_SIZE: Final = 65536


class InMemoryStream:
    """One end of a connection: the server's `Stream`, or the client's end, which a test uses alike."""

    def __init__(self, peer: str, uid: int | None, buffer_size: int = _BUFFER_SIZE) -> None:
        self.peer = peer
        self.uid = uid
        self.other = self  # the other end
        self.number = -1  # its descriptor, once it is accepted
        self.closed = False
        self._received = bytearray()
        self._buffer_size = buffer_size
        self._ended = False  # the other end sends nothing more
        self._end_sent = False  # this end sends nothing more
        self._gone = False  # reset: the other end is no more
        self._told = True  # of that: the next call raises an error if not

    def fileno(self) -> int:
        return -1 if self.closed else self.number

    def peer_uid(self) -> int | None:
        over = self._ended and self._end_sent
        return None if self.closed or self._gone or self.other.closed or over else self.uid

    @property
    def readable(self) -> bool:
        return bool(self._received) or self._ended or self._gone

    @property
    def writable(self) -> bool:
        return self._gone or self._end_sent or self.other.closed or self._room() > 0

    def recv(self, size: int, /) -> bytes:
        self._check_open()
        if not self._received:
            if not self._ended:
                self._tell()
            if not self.readable:
                raise BlockingIOError
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def recv_all(self) -> bytes:
        """Everything that has arrived, b"" if nothing has."""
        return self.recv(len(self._received)) if self._received or not self._told else b""

    def send(self, data: bytes | memoryview, /) -> int:
        self._check_open()
        self._tell()
        if self._gone or self._end_sent:
            raise BrokenPipeError
        if self.other.closed:  # nobody is there to take it, which is found out by sending it
            self._gone = True
            return len(data)
        if not (count := min(len(data), self._room())):
            raise BlockingIOError
        self.other._received += data[:count]
        return count

    def end_sending(self) -> None:
        if not (self.closed or self._gone):
            self._end_sent = self.other._ended = True

    def close(self) -> None:
        if self._received:
            self.reset()
        elif not self.closed:
            self.closed = self.other._ended = True

    def reset(self) -> None:
        """Close both sides; the other end finds the connection reset after what it has received."""
        if not (self.closed or self._gone or self.other._gone):
            self.other._gone = True
            if not self.other._ended:
                self.other._told = False
        self.closed = True

    @property
    def at_end(self) -> bool:
        """Whether nothing more comes: everything until the other end closed was read, or it was reset."""
        return (self._gone or self._ended) and not self._received

    def _room(self) -> int:
        return self.other._buffer_size - len(self.other._received)

    def _check_open(self) -> None:
        if self.closed:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))

    def _tell(self) -> None:
        """Raise the error of a reset, once."""
        if not self._told:
            self._told = True
            raise ConnectionResetError


class InMemoryTransport:
    """A `Transport` whose clients are in the same process; waiting in vain advances the clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._accepted: dict[int, InMemoryStream] = {}  # by descriptor
        self._arriving: dict[int, deque[InMemoryStream]] = {fd: deque() for fd in range(_LISTENERS)}
        self._ports = itertools.count(1)

    def connect(self, uid: int | None = 0, *, buffer_size: int = _BUFFER_SIZE, to: int = 0) -> InMemoryStream:
        """The client's end of a new connection of user `uid`, with this receive buffer, to a listener.

        ConnectionRefusedError once nobody listens.
        """
        if to not in self._arriving:
            raise ConnectionRefusedError
        server_end = InMemoryStream(f"memory:{next(self._ports)}", uid)
        client_end = InMemoryStream("server", None, buffer_size)
        server_end.other, client_end.other = client_end, server_end
        self._arriving[to].append(server_end)
        return client_end

    def listening(self) -> Sequence[int]:
        return tuple(self._arriving)

    def accept(self, fd: int) -> InMemoryStream | None:
        if not (arriving := self._arriving[fd]):
            return None
        stream = arriving.popleft()
        numbers = itertools.count(_LISTENERS)
        stream.number = next(n for n in numbers if n not in self._accepted or self._accepted[n].closed)
        self._accepted[stream.number] = stream
        return stream

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        ready = self._ready(readers, writers)
        if ready[0] or ready[1] or seconds <= 0:
            return ready
        self._clock.sleep(seconds)
        return self._ready(readers, writers)

    def stop_listening(self) -> None:
        for arriving in self._arriving.values():
            for stream in arriving:
                stream.reset()
        self._arriving.clear()

    def close(self) -> None:
        self.stop_listening()

    def _ready(self, readers: Collection[int], writers: Collection[int]) -> tuple[list[int], list[int]]:
        # In the order in which they are asked for, as select does.
        return (
            [
                fd for fd in readers
                if (self._arriving[fd] if fd in self._arriving else self._open(fd).readable)
            ],
            [fd for fd in writers if self._open(fd).writable],
        )  # fmt: skip

    def _open(self, fd: int) -> InMemoryStream:
        if (stream := self._accepted.get(fd)) is None or stream.closed:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return stream
