"""All clients: accepts them, hands samples out and answers requests in the time between two exchanges.

It runs in the acquisition loop's thread. No client can delay the bus, because

- nothing here waits for a client,
- one pass over the clients answers at most one request of each, and begins none shortly before the deadline,
- a pass is followed by a pause nine times as long, in which replies and samples are sent but nothing is read.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from functools import reduce
from operator import or_
from typing import Final

from bota_ethercat.control import ErrorCode, error_reply
from bota_ethercat.errors import RequestError
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.ethercat.clock import SYSTEM_CLOCK
from ethercat_server.serving.connection import Connection, ConnectionState, Timeouts, Unreadable, Watched
from ethercat_server.serving.permissions import Permissions
from ethercat_server.serving.transport import Transport

_PAUSE_RATIO: Final = 9  # clients get at most a tenth of this thread's time, however much they ask
# A pass that took long because this thread was not running must not silence all clients.
_LONGEST_PAUSE_NS: Final = 20_000_000
_REQUEST_NS: Final = 280_000  # no request is begun this shortly before a deadline; a usual one takes less
_MAX_ACCEPTS: Final = 2  # clients accepted in one pass
_SWEEP_NS: Final = 50_000_000  # how often connections are checked for timeouts and closed
_CLOSE_NS: Final = 1_000_000_000
_CLOSE_TURN_NS: Final = 20_000_000

log = logging.getLogger(__name__)

# Turns a request into its reply, or None if it comes later through `Hub.answer`; RequestError refuses it.
Handler = Callable[[Connection, JsonObject], JsonObject | None]


class Hub:
    """All client connections. Not thread-safe: one thread does everything."""

    def __init__(self, transport: Transport, clock_ns: Callable[[], int] = SYSTEM_CLOCK.raw_ns) -> None:
        self.connections: dict[int, Connection] = {}  # by file descriptor
        self.timeouts = Timeouts()
        self.permissions = Permissions()
        self._transport = transport
        self._clock_ns = clock_ns
        self._handler: Handler | None = None
        self._subscribers: list[Connection] = []
        self._watched = Watched(set(), set())
        self._ready: deque[Connection] = deque()  # those that are READY, in the order of their turns
        self._pause_ends_ns = 0
        self._sweep_at_ns = 0

    def start(self, handler: Handler) -> None:
        """Begin to accept; until now clients waited in the kernel's queue."""
        self._handler = handler
        self._watched.readers.update(self._transport.listening())

    def publish(self, made: Sequence[OutgoingFrame], now_ns: int) -> None:
        """Send DATA frames to every subscriber that wants them."""
        flags = made[0][2] if len(made) == 1 else reduce(or_, [each[2] for each in made])
        for connection in self._subscribers:
            connection.offer(made, flags, now_ns)

    def broadcast(self, message: JsonObject) -> None:
        """Send an event to every framed connection."""
        for connection in self.connections.values():
            if connection.framed is not None and not connection.state.ending:
                connection.send_json(message)

    def answer(self, connection: Connection, reply: JsonObject) -> None:
        """Send the reply that a handler left for later, and go on with what the client sent after it."""
        if self.connections.get(connection.fd) is not connection:
            return
        connection.send_json(reply)
        if connection.state is ConnectionState.ANSWERING:
            connection.answered()
            self._ready.append(connection)

    def subscriptions_changed(self) -> None:
        """A connection's subscription began or ended."""
        self._subscribers = [c for c in self.connections.values() if c.subscription is not None]

    def serve(self, until_ns: int) -> int:
        """Serve the clients until the clock is at `until_ns`; once, without waiting, if that has passed.

        Returns the time.
        """
        watched, now_ns, last_start_ns = self._watched, self._clock_ns(), until_ns - _REQUEST_NS
        # One pass is always made, also where there is never time for a request before a deadline.
        hurried = last_start_ns <= now_ns
        while hurried or now_ns < until_ns:
            reads, wake_ns = hurried or now_ns < last_start_ns, until_ns
            if hurried or self._ready or now_ns < self._pause_ends_ns:
                if now_ns < self._pause_ends_ns:
                    reads, wake_ns = False, min(self._pause_ends_ns, until_ns)
                elif reads:
                    wake_ns = now_ns
            wait_s = (wake_ns - now_ns) * 1e-9 if wake_ns > now_ns else 0.0
            ready = self._transport.wait(watched.readers if reads else (), watched.writers, wait_s)
            if ready[0] or ready[1] or (reads and self._ready):
                self._serve_ready(*ready, last_start_ns, reads=reads, hurried=hurried)
            hurried, now_ns = False, self._clock_ns()
        if now_ns >= self._sweep_at_ns:
            self._sweep(now_ns)
        return now_ns

    def _serve_ready(
        self,
        readable: Sequence[int],
        writable: Sequence[int],
        last_start_ns: int,
        *,
        reads: bool,
        hurried: bool,
    ) -> None:
        """Send what waits; then read and answer if `reads`, unless it is too late to begin."""
        for fd in writable:
            self.connections[fd].outbox.flush()
        began_ns = self._clock_ns()
        # What came too late to be begun has its turn after the exchange.
        if reads and (hurried or began_ns < last_start_ns):
            self._read(readable)
            self._answer_some(last_start_ns)
            ended_ns = self._clock_ns()
            self._pause_ends_ns = ended_ns + min(_PAUSE_RATIO * (ended_ns - began_ns), _LONGEST_PAUSE_NS)

    def _read(self, readable: Sequence[int]) -> None:
        listening = []
        for fd in readable:
            if (connection := self.connections.get(fd)) is None:
                listening.append(fd)
                continue
            connection.receive()
            if connection.state is ConnectionState.READY:
                self._ready.append(connection)
            elif connection.state.ending:
                self._sweep_at_ns = 0
        # Last: it may close connections that were idle until this pass.
        for fd in listening:
            self._accept(fd)

    def _accept(self, fd: int) -> None:
        for _ in range(_MAX_ACCEPTS):
            if (stream := self._transport.accept(fd)) is None:
                return
            connection = Connection(stream, stream.peer_uid(), self._clock_ns, self._watched)
            if self._make_room(connection.uid):
                self.connections[connection.fd] = connection
            else:
                log.warning("%s refused: there are %d clients already", connection, len(self.connections))
                connection.close()

    def _make_room(self, uid: int | None) -> bool:
        """Whether the user `uid` may connect once more, if need be in place of an idle connection."""
        clients = self.connections.values()
        if self.permissions.have_room(uid, clients):
            return True
        if (idle := self.permissions.dispensable(uid, clients)) is None:
            return False
        log.warning("%s closed: it is idle, and its user has most of the %d clients", idle, len(clients))
        why = "closed in favor of another user: too many connections of yours are idle"
        idle.send_json(error_reply(None, ErrorCode.BAD_REQUEST, why))
        idle.close()
        del self.connections[idle.fd]
        return True

    def _answer_some(self, until_ns: int) -> None:
        """One request of each that has sent some, until the time is up; the others are first next time."""
        for _ in range(len(self._ready)):
            connection = self._ready.popleft()
            if connection.state is ConnectionState.READY:
                self._answer_one(connection)
            if self._clock_ns() >= until_ns:
                return

    def _answer_one(self, connection: Connection) -> None:
        message = connection.next_message()
        if isinstance(message, Unreadable):
            connection.send_json(error_reply(None, ErrorCode.BAD_REQUEST, message.reason))
        elif message is not None:
            answer = self._handle(connection, message)
            if answer is None:
                connection.answer_later()
            else:
                connection.send_json(answer)
        if connection.state is ConnectionState.READY:
            self._ready.append(connection)
        elif connection.state.ending:
            self._sweep_at_ns = 0
            self.subscriptions_changed()

    def _handle(self, connection: Connection, message: JsonObject) -> JsonObject | None:
        assert self._handler is not None
        try:
            return self._handler(connection, message)
        except RequestError as error:
            return error_reply(message, error.code, str(error), **error.extra)
        except Exception:  # a defect in one action must not stop the acquisition
            log.exception("internal error in a request: %.200r", message)
            return error_reply(message, ErrorCode.INTERNAL, "the server failed on this request: see its log")

    def _sweep(self, now_ns: int) -> None:
        """Close those that are beyond a timeout, have received their last reply, or are broken."""
        self._sweep_at_ns = now_ns + _SWEEP_NS
        for connection in self.connections.values():
            if complaint := connection.reason_to_close(now_ns, self.timeouts):
                log.warning("%s closed: %s", connection, complaint)
                if connection.outbox.waiting:
                    connection.fail()
                else:
                    connection.send_json(error_reply(None, ErrorCode.BAD_REQUEST, complaint))
                    connection.finish()
            connection.settle(now_ns)
        gone = [each for each in self.connections.values() if each.state is ConnectionState.CLOSED]
        for connection in gone:
            del self.connections[connection.fd]
            connection.close()
        if gone:
            self.subscriptions_changed()

    def close(self) -> None:
        """Send what waits, for a bounded time, then close everything."""
        self._watched.readers.difference_update(self._transport.listening())
        self._transport.stop_listening()
        for connection in self.connections.values():
            connection.finish()
        self.subscriptions_changed()
        deadline_ns = self._clock_ns() + _CLOSE_NS
        while self.connections and (now_ns := self._clock_ns()) < deadline_ns:
            self.serve(now_ns + _CLOSE_TURN_NS)
        for connection in self.connections.values():
            connection.close()
        self.connections.clear()
        self._transport.close()
