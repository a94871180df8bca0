"""A framed connection over TCP; the only file here that opens a socket.

`protocol.client.Client` and the ROS node, which has threads, are built on it.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import struct
from typing import Final

from protocol.address import boot_id
from protocol.errors import ConnectionFailedError, ProtocolError, UnreachableError
from protocol.framing import DataMessage, FrameDecoder, encode_json
from protocol.text.json_text import JsonObject
from protocol.text.visible import printable

CONNECT_TIMEOUT_S: Final = 2.0
SILENCE_S: Final = 1.0
"""`receive` gives up waiting after this time, so that silence can be reported."""
RECEIVE_BUFFER: Final = 65536
"""SO_RCVBUF in bytes. Left to itself the kernel makes it megabytes, and samples wait in it for seconds."""
_KEEPALIVE: Final = tuple(
    (getattr(socket, option), value)
    for option, value in (("TCP_KEEPIDLE", 2), ("TCP_KEEPALIVE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3))
    if hasattr(socket, option)  # the second is what macOS calls the first
)
_DONT_WAIT: Final = getattr(socket, "MSG_DONTWAIT", 0)
"""0 on Windows, where the socket's timeouts would be of another type, too: there it waits with `select`."""
_Selector: Final = getattr(selectors, "PollSelector", selectors.SelectSelector)
"""`select` takes no descriptor above 1023. Windows, which has nothing else, limits their number only."""


class FramedConnection:
    """A connection to the server at `host`:`port`.

    Attributes:
        same_machine: whether the server's CLOCK_MONOTONIC is ours; by its address until `take_description`.
        sock: the socket, blocking, with the kernel's timeouts of SILENCE_S (not on Windows).
    """

    def __init__(self, host: str, port: int, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        """Connect; UnreachableError if there is nothing to connect to."""
        self._decoder = FrameDecoder()
        if not 0 < port < 65536:  # create_connection would leave a socket behind
            raise UnreachableError(f"{port} is no port: it must be from 1 to 65535")
        try:
            self.sock = socket.create_connection((host, port), timeout=timeout_s)
        except (OSError, UnicodeError) as error:  # UnicodeError: a host name that cannot be one
            raise UnreachableError(_reason(error)) from None
        try:
            self._prepare_socket()
        except OSError as error:
            self.sock.close()
            raise UnreachableError(str(error)) from None

    def _prepare_socket(self) -> None:
        ours, theirs = self.sock.getsockname(), self.sock.getpeername()
        if ours == theirs:  # a free ephemeral port can connect to itself
            raise OSError("nothing listens there")
        self.same_machine: bool = ours[0] == theirs[0]
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        # Detects a peer that disappeared without closing the connection.
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE:
            self.sock.setsockopt(socket.IPPROTO_TCP, option, value)
        # The kernel's own timeouts cost no system call per read, as settimeout() would.
        self.sock.settimeout(None)
        if _DONT_WAIT:
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(SILENCE_S))
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _timeval(SILENCE_S))

    def take_description(self, description: JsonObject) -> None:
        """Learn whose clock the server has from its reply to `describe`: the address may be a tunnel's."""
        theirs, ours = description.get("boot_id"), boot_id()
        if isinstance(theirs, str) and ours is not None:
            self.same_machine = theirs == ours

    def fileno(self) -> int:
        """For `select` and `poll`: readable when something has arrived, besides what is buffered here."""
        return self.sock.fileno()

    def wait(self, timeout_s: float) -> bool:
        """Whether something arrives within `timeout_s`; ConnectionFailedError if this end has been closed."""
        try:
            with _Selector() as selector:
                selector.register(self, selectors.EVENT_READ)
                return bool(selector.select(max(timeout_s, 0.0)))
        except (ValueError, OSError):  # closed before, or by another thread at this very moment
            raise ConnectionFailedError("this client has been closed") from None

    def receive(self, *, wait: bool = True) -> bool | None:
        """Take what has arrived, at most one buffer full, blocking for the first byte if `wait`.

        True if more may be waiting, False if that was all, None if nothing came within SILENCE_S (or, not
        waiting, there is nothing). Then call `next_message`. ConnectionFailedError when it is over.
        """
        if not _DONT_WAIT and not self.wait(SILENCE_S if wait else 0.0):
            return None
        with self._decoder.get_buffer() as buffer:
            try:
                count = self.sock.recv_into(buffer, 0, 0 if wait else _DONT_WAIT)
            except BlockingIOError:
                return None
            except OSError as error:
                raise ConnectionFailedError(error.strerror or str(error)) from None
            if count == 0:
                raise ConnectionFailedError("the server closed it")
            self._decoder.received(count)
            return count == len(buffer)

    def next_message(self) -> DataMessage | JsonObject | None:
        """The next whole message received; ConnectionFailedError if the bytes are not this protocol."""
        try:
            return self._decoder.next_message()
        except ProtocolError as error:
            raise ConnectionFailedError(f"what came is not this protocol: {printable(error)}") from None

    def take_data(self, into: list[DataMessage]) -> JsonObject | None:
        """As `FrameDecoder.take_data`; ConnectionFailedError if the bytes are not this protocol."""
        try:
            return self._decoder.take_data(into)
        except ProtocolError as error:
            raise ConnectionFailedError(f"what came is not this protocol: {printable(error)}") from None

    def send(self, message: JsonObject) -> None:
        """Send a message; ConnectionFailedError if it cannot be sent."""
        try:
            self.sock.sendall(encode_json(message))
        except OSError as error:
            raise ConnectionFailedError(f"cannot send: {error.strerror or error}") from None

    def shutdown(self) -> None:
        """End the connection from any thread; a blocked `receive` returns."""
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the socket."""
        self.shutdown()
        self.sock.close()


def _reason(error: OSError | UnicodeError) -> str:
    """Why there is no connection, without numbers."""
    if isinstance(error, socket.gaierror):  # has numbers of its own
        return error.strerror or str(error)
    return os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)


def _timeval(seconds: float) -> bytes:
    return struct.pack("@ll", int(seconds), int(seconds % 1 * 1e6))
