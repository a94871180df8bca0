"""The TCP side: listens, accepts, serves the connections in the time between two exchanges.

It runs in the acquisition's own thread and only until the deadline it is given, so that no client can delay
the bus.
"""

from __future__ import annotations

import errno
import logging
import select
import socket
import time
from collections.abc import Callable, Sequence
from typing import Final

from ethercat_server.connection import Connection, Limits
from ethercat_server.errors import ServerError
from ethercat_server.socket_owner import open_diagnostics, peer_uid
from protocol.control import ErrorCode, error_reply
from protocol.errors import BadMessageError, RemoteProtocolError, RequestError
from protocol.framing import JsonObject

MAX_CLIENTS: Final = 64
RESERVED: Final = 16
"""So many of them are for users who may control: strangers cannot take all."""
_LAST_WORDS_S: Final = 1.0
"""How long a closing connection may take to accept its last reply."""

_SWEEP_NS: Final = 50_000_000
_ACCEPTS_AT_ONCE: Final = 8
_BACKLOG: Final = 128

log = logging.getLogger(__name__)

Handler = Callable[[Connection, JsonObject], JsonObject | None]
"""Turns a request into its reply, or None if it comes later through `Hub.answer`; RequestError refuses it."""


class Hub:
    """All client connections. Not thread-safe: one thread does everything."""

    def __init__(self, hosts: Sequence[str], port: int) -> None:
        """Binds at once, so that a taken port is found before the bus is touched; ServerError then."""
        self.port = port
        self.connections: dict[int, Connection] = {}
        self._subscribers: list[Connection] = []
        self._closing_since: dict[int, float] = {}
        self._handler: Handler | None = None
        self._listeners = _listen(hosts, port)
        self._readers: list[int] = []
        self._unread: list[Connection] = []
        self._hasty: list[Connection] = []
        """They have asked too much lately and wait for their turn."""
        self._diagnostics = open_diagnostics()
        self.control_uids: frozenset[int] = frozenset({0})
        """Users who may change something."""
        self.limits = Limits()
        self._sweep_at_ns = 0

    def start(self, handler: Handler) -> None:
        """Begin to accept; until now clients waited in the kernel's queue."""
        self._handler = handler
        self._update_readers()

    def publish(self, frame: bytes, place: int, flags: int, now_ns: int) -> None:
        """Hand a DATA frame of the sensor at `place` to every subscriber that wants it."""
        for connection in self._subscribers:
            connection.offer(frame, place, flags, now_ns)

    def broadcast(self, message: JsonObject) -> None:
        """Send an event to every framed connection."""
        for connection in self.connections.values():
            if connection.framed is not None and not connection.closing:
                connection.send_json(message)

    def answer(self, connection: Connection, reply: JsonObject) -> None:
        """Send the reply that a handler left for later; what the client sent behind it comes next."""
        if self.connections.get(connection.fd) is not connection:
            return
        connection.busy = False
        connection.send_json(reply)
        if connection.unread:
            self._unread.append(connection)
        self._update_readers()

    def may_control(self, connection: Connection) -> bool:
        """Whether the user at the other end may change something. What is not known is refused."""
        if connection.uid is None:
            connection.uid = peer_uid(self._diagnostics, connection.sock)
        return connection.uid in self.control_uids

    def subscriptions_changed(self) -> None:
        """A connection's subscription was made or ended."""
        self._subscribers = [c for c in self.connections.values() if c.subscription is not None]

    def serve(self, until_ns: int) -> None:
        """Serve the sockets until CLOCK_MONOTONIC is `until_ns`; one look at each if that is past."""
        if self._hasty:
            self._unread += [c for c in self._hasty if self.connections.get(c.fd) is c]
            self._hasty = []
        while True:
            left = 0 if self._unread else max(0, until_ns - time.monotonic_ns())
            writers = [c.fd for c in self.connections.values() if c.outbox.waiting]
            readable, writable, _ = select.select(self._readers, writers, (), left * 1e-9)
            if not readable and not writable and not self._unread:
                break
            for fd in writable:
                self.connections[fd].outbox.flush()
            for fd in readable:
                self._read(fd)
            self._answer_one_each()
            if time.monotonic_ns() >= until_ns:
                break
        if time.monotonic_ns() >= self._sweep_at_ns:
            self._sweep()

    def close(self) -> None:
        """Send what waits, for a bounded time, then close everything."""
        for listener in self._listeners:
            listener.close()
        self._listeners = []
        self._update_readers()
        deadline = time.monotonic() + _LAST_WORDS_S
        for connection in self.connections.values():
            connection.subscription = None
            connection.closing = True
        self.subscriptions_changed()
        while self.connections and time.monotonic() < deadline:
            self.serve(time.monotonic_ns() + 20_000_000)
        for connection in self.connections.values():
            connection.close()
        self.connections.clear()
        self._diagnostics.close()

    def _accept(self, fd: int) -> None:
        listener = next((item for item in self._listeners if item.fileno() == fd), None)
        if listener is None:
            return
        for _ in range(_ACCEPTS_AT_ONCE):
            try:
                sock, _ = listener.accept()
            except OSError:
                break
            uid = peer_uid(self._diagnostics, sock)
            connection = Connection(sock, uid)
            if len(self.connections) >= MAX_CLIENTS - RESERVED * (uid not in self.control_uids):
                log.warning("%s refused: there are %d clients already", connection, len(self.connections))
                connection.close()
                continue
            self.connections[connection.fd] = connection
        self._update_readers()

    def _read(self, fd: int) -> None:
        connection = self.connections.get(fd)
        if connection is None:
            self._accept(fd)
            return
        connection.receive()
        if connection.unread:
            # What it sends further stays in the kernel until this is answered: a flood waits its turn.
            self._unread.append(connection)
        self._update_readers()

    def _answer_one_each(self) -> None:
        """Answer one message of each connection that has some: none makes the others wait for all of its."""
        waiting, self._unread = self._unread, []
        for connection in waiting:
            if not connection.may_ask(time.monotonic_ns()):
                self._hasty.append(connection)
                continue
            message = connection.next_message()
            if isinstance(message, RemoteProtocolError | BadMessageError):
                connection.send_json(error_reply(None, ErrorCode.BAD_REQUEST, str(message)))
            elif message is not None:
                answer = self._answer(connection, message)
                connection.busy = answer is None
                if answer is not None:
                    connection.send_json(answer)
            if connection.unread and not connection.busy and not connection.dead:
                self._unread.append(connection)
                continue
            self._update_readers()
            if connection.closing or connection.dead:
                self._sweep_at_ns = 0
                self.subscriptions_changed()

    def _answer(self, connection: Connection, message: JsonObject) -> JsonObject | None:
        assert self._handler is not None
        try:
            return self._handler(connection, message)
        except RequestError as error:
            return error_reply(message, error.code, str(error), **error.extra)
        except Exception:  # no request, however odd, may end the acquisition
            log.exception("a request failed: %.200r", message)
            return error_reply(None, ErrorCode.INTERNAL, "the request failed in the server: see its log")

    def _sweep(self) -> None:
        """Close what is dead, has said its last words or takes too long."""
        now_ns = time.monotonic_ns()
        self._sweep_at_ns = now_ns + _SWEEP_NS
        gone = []
        for connection in self.connections.values():
            if not connection.closing and (complaint := connection.complaint(now_ns, self.limits)):
                log.warning("%s closed: %s", connection, complaint)
                connection.failed = connection.outbox.waiting
                connection.send_json(error_reply(None, ErrorCode.BAD_REQUEST, complaint))
                connection.finish()
            if connection.closing and not connection.dead:
                since = self._closing_since.setdefault(connection.fd, time.monotonic())
                connection.failed = time.monotonic() - since > _LAST_WORDS_S
                if not connection.outbox.waiting:
                    connection.end_sending()
                    connection.failed = connection.failed or connection.end_of_input
            if connection.dead:
                gone.append(connection)
        for connection in gone:
            del self.connections[connection.fd]
            self._closing_since.pop(connection.fd, None)
            connection.close()
        if gone:
            self.subscriptions_changed()
            self._update_readers()

    def _update_readers(self) -> None:
        self._readers = [listener.fileno() for listener in self._listeners]
        self._readers += [
            fd for fd, c in self.connections.items() if not (c.end_of_input or c.unread or c.busy or c.dead)
        ]


def _listen(hosts: Sequence[str], port: int) -> list[socket.socket]:
    listeners: list[socket.socket] = []
    for host in hosts:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.socket(family, socket.SOCK_STREAM)
        except OSError:
            continue  # no IPv6 on this machine
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:  # IPv4 has a listener of its own
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        try:
            listener.bind((host, port))
            listener.listen(_BACKLOG)
        except OSError as error:
            listener.close()
            if error.errno == errno.EADDRNOTAVAIL and listeners:
                continue  # no address ::1 on this machine
            for other in listeners:
                other.close()
            reason = (
                "is taken by another program"
                if error.errno == errno.EADDRINUSE
                else f"cannot be used: {error.strerror}"
            )
            raise ServerError(
                f"port {port} on {host} {reason}; stop that program or choose another port"
            ) from None
        listener.setblocking(False)
        listeners.append(listener)
    return listeners
