"""The TCP side: serves the connections in the time between two exchanges.

It runs in the acquisition's own thread and only until the deadline it is given, so that no client can delay
the bus.
"""

from __future__ import annotations

import logging
import select
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from ethercat_server.connection import Connection, Limits, Unreadable
from ethercat_server.door import Door
from protocol.control import ErrorCode, error_reply
from protocol.errors import RequestError
from protocol.json_text import JsonObject

_LAST_WORDS_S: Final = 1.0
"""How long a closing connection may take to accept its last reply."""

_SWEEP_NS: Final = 50_000_000
_LEAST_TURN_NS: Final = 200_000
"""So long a turn takes at least, even if the deadline has passed: nobody is shut out for ever."""
_FORCE_EVERY_NS: Final = 20_000_000

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
        self.door = Door(hosts, port)
        self._readers: list[int] = []
        self._readers_changed = True
        self._first = 0
        """Where among the readable sockets a turn begins: another one each time."""
        self._unread: deque[Connection] = deque()
        self._force_at_ns = 0
        self._hasty: list[Connection] = []
        """They have asked too much lately and wait for their turn."""
        self.limits = Limits()
        self._sweep_at_ns = 0

    def start(self, handler: Handler) -> None:
        """Begin to accept; until now clients waited in the kernel's queue."""
        self._handler = handler
        self._readers_changed = True

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
        self._readers_changed = True

    def subscriptions_changed(self) -> None:
        """A connection's subscription was made or ended."""
        self._subscribers = [c for c in self.connections.values() if c.subscription is not None]

    def serve(self, until_ns: int) -> None:
        """Serve the sockets until CLOCK_MONOTONIC is `until_ns`, and a little if that is past.

        Each socket and each message takes a fraction of a millisecond; what there is no time for has its turn
        the next time, so that no crowd of clients keeps the loop from its deadline.
        """
        until_ns = max(until_ns, time.monotonic_ns() + _LEAST_TURN_NS)
        if self._hasty:
            self._unread.extend(c for c in self._hasty if self.connections.get(c.fd) is c)
            self._hasty = []
        while self._serve_once(until_ns) and time.monotonic_ns() < until_ns:
            pass
        if time.monotonic_ns() >= self._sweep_at_ns:
            self._sweep()

    def _serve_once(self, until_ns: int) -> bool:
        """Wait for something to do and do it; False if there was nothing."""
        if self._readers_changed:
            self._update_readers()
        left = 0 if self._unread else max(0, until_ns - time.monotonic_ns())
        writers = [c.fd for c in self.connections.values() if c.outbox.waiting]
        readable, writable, _ = select.select(self._readers, writers, (), left * 1e-9)
        if not readable and not writable and not self._unread:
            return False
        for fd in writable:
            self.connections[fd].outbox.flush()
        # Where time is short, the two take turns in who is first.
        self._first += 1
        if self._first % 2:
            self._read_some(readable, until_ns)
        # One message of each connection at most: none makes the others wait for all of its own.
        for _ in range(len(self._unread)):
            now_ns = time.monotonic_ns()
            if now_ns >= until_ns:
                return True
            connection = self._unread.popleft()
            # A long message waits until there is time for it; now and then one is taken all the same.
            if now_ns + connection.effort_ns > until_ns:
                if now_ns < self._force_at_ns:
                    self._unread.append(connection)
                    continue
                self._force_at_ns = now_ns + _FORCE_EVERY_NS
            self._take_message(connection)
        if not self._first % 2:
            self._read_some(readable, until_ns)
        return True

    def _read_some(self, readable: list[int], until_ns: int) -> None:
        for turn in range(len(readable)):
            if time.monotonic_ns() >= until_ns:
                break
            self._read(readable[(self._first + turn) % len(readable)])

    def close(self) -> None:
        """Send what waits, for a bounded time, then close everything."""
        self.door.shut()
        self._readers_changed = True
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
        self.door.close()

    def _read(self, fd: int) -> None:
        connection = self.connections.get(fd)
        if connection is None:
            self.connections |= {new.fd: new for new in self.door.accept(fd, self.connections.values())}
            self._readers_changed = True
            return
        connection.receive()
        if connection.unread:
            # What it sends further stays in the kernel until this is answered: a flood waits its turn.
            self._unread.append(connection)
        self._readers_changed = True

    def _take_message(self, connection: Connection) -> None:
        if not connection.may_ask(time.monotonic_ns()):
            self._hasty.append(connection)
            return
        message = connection.next_message()
        if isinstance(message, Unreadable):
            connection.send_json(error_reply(None, ErrorCode.BAD_REQUEST, message.reason))
        elif message is not None:
            answer = self._answer(connection, message)
            connection.busy = answer is None
            if answer is not None:
                connection.send_json(answer)
        if connection.unread and not connection.busy and not connection.dead:
            self._unread.append(connection)
            return
        self._readers_changed = True
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
            self._readers_changed = True

    def _update_readers(self) -> None:
        self._readers_changed = False
        self._readers = self.door.fds()
        self._readers += [
            fd for fd, c in self.connections.items() if not (c.end_of_input or c.unread or c.busy or c.dead)
        ]
