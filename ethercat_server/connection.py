"""One client's connection: who it is, what it sent so far, which DATA it wants. It never blocks."""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Final, NamedTuple

from ethercat_server.outbox import Outbox, with_gap
from protocol.address import Address
from protocol.bare_json import BARE_JSON_FIRST_BYTE, BareJsonDecoder, encode_bare_json
from protocol.errors import BadMessageError, RemoteProtocolError
from protocol.framing import DataFlag, FrameDecoder, encode_json
from protocol.json_text import JsonObject

MAX_REQUEST_LENGTH: Final = 4096
_SEND_BUFFER: Final = 65536
"""Small, so that a client that stalls finds fresh data soon after, not seconds of old."""
_IDLE_FRAME_NS: Final = 10_000_000
"""A `fresh_only` client gets a REPEATED frame only when it has had nothing for this long."""
_REPEATED: Final = int(DataFlag.REPEATED)
_GAP: Final = int(DataFlag.GAP)
_UNFINISHED_NS: Final = 10_000_000_000
"""A message that has begun must end within this."""
_EFFORT_NS: Final = 30_000
_EFFORT_PER_BYTE_NS: Final = 250
"""What it takes to read and answer a message, at the worst: one made up of many small values."""
_COST_NS: Final = 2_000_000
_MOST_CREDIT_NS: Final = 100 * _COST_NS
"""A client may ask 500 times a second, and 100 times at once after a pause; what is more waits its turn."""


class Limits(NamedTuple):
    """What a client may take its time for."""

    stall_ns: float = 10e9
    """Without taking anything of what waits for it."""
    idle_ns: float = 300e9
    """Without a request while it is not subscribed."""


class Unreadable(NamedTuple):
    """A message that could not be read. No exception: one that is kept in a variable keeps itself alive."""

    reason: str


class Subscription:
    """Which DATA a client wants. Lists are by sensor place."""

    __slots__ = ("every", "fresh_only", "gap", "last_ns", "skipped", "wanted")

    def __init__(
        self, sensor_count: int, sensors: tuple[int, ...] | None, every: int, fresh_only: bool
    ) -> None:
        self.wanted = [sensors is None or place in sensors for place in range(sensor_count)]
        self.every = every
        self.fresh_only = fresh_only
        self.skipped = [every - 1] * sensor_count
        self.last_ns = [0] * sensor_count
        self.gap = [False] * sensor_count


class Connection:
    """A client's socket and everything that belongs to it."""

    def __init__(self, sock: socket.socket, uid: int | None = None) -> None:
        """`uid` is the user who owns the other end, None if that is not known."""
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self.sock = sock
        self.fd = sock.fileno()
        self.peer = _address_text(sock)
        self.uid = uid
        self.framed: FrameDecoder | None = None
        self.bare: BareJsonDecoder | None = None
        self.subscription: Subscription | None = None
        self.outbox = Outbox(sock)
        self.failed = False
        """Close it without more ado: reading failed, or it broke a bound."""
        self.closing = False
        """What it still sends is thrown away; close it once everything is sent."""
        self.unread = False
        """Whole messages may be waiting to be taken by `next_message`."""
        self.end_of_input = False
        """The peer has closed its side."""
        self.busy = False
        """Its last request is not answered yet; what it sent behind it waits."""
        self._heard_ns = time.monotonic_ns()
        self._begun_ns = 0
        """Since when a message of which only a part has come is waited for; 0 if there is none."""
        self._credit_ns = _MOST_CREDIT_NS
        self._credited_ns = self._heard_ns

    @property
    def dead(self) -> bool:
        """Whether there is nothing left but to close it."""
        return self.failed or self.outbox.broken

    def __str__(self) -> str:
        """For the log. The user by number: names may have to be asked for over the network."""
        return f"client {self.peer} (uid {'unknown' if self.uid is None else self.uid})"

    # -- receiving

    def receive(self) -> None:
        """Read what has arrived, at most one request's worth; then ask `next_message` until it gives None."""
        try:
            data = self.sock.recv(MAX_REQUEST_LENGTH)
        except BlockingIOError:
            return
        except OSError:
            self.failed = True
            return
        if not data:
            self.end_of_input = True
        if self.closing:
            return  # thrown away, so that closing does not reset the connection under the last reply
        if self.framed is None and self.bare is None and data:
            if data.startswith(BARE_JSON_FIRST_BYTE):
                self.bare = BareJsonDecoder(max_json_length=MAX_REQUEST_LENGTH)
            else:
                self.framed = FrameDecoder(max_json_length=MAX_REQUEST_LENGTH, accept_data=False)
        if not data and self.bare is not None:
            self.bare.end_of_input()
        decoder = self.framed or self.bare
        if decoder is not None:
            decoder.feed(data)
        self.unread = True

    @property
    def effort_ns(self) -> int:
        """How long it may take to answer what has come."""
        size = self.framed.next_size if self.framed else self.bare.pending if self.bare else 0
        return _EFFORT_NS + _EFFORT_PER_BYTE_NS * min(size, MAX_REQUEST_LENGTH)

    def may_ask(self, now_ns: int) -> bool:
        """Whether it is this client's turn to be answered once more: none may ask without pause."""
        self._credit_ns = min(_MOST_CREDIT_NS, self._credit_ns + now_ns - self._credited_ns)
        self._credited_ns = now_ns
        if self._credit_ns < _COST_NS:
            return False
        self._credit_ns -= _COST_NS
        return True

    def complaint(self, now_ns: int, limits: Limits) -> str | None:
        """Why this client is to be closed, if it is."""
        if self.outbox.waiting:
            if now_ns - self.outbox.took_ns > limits.stall_ns:
                return f"it has taken nothing of what waits for it for {limits.stall_ns / 1e9:g} s"
        elif self._begun_ns and now_ns - self._begun_ns > _UNFINISHED_NS:
            return f"it has not finished its message for {_UNFINISHED_NS / 1e9:g} s"
        elif self.subscription is None and not self.busy and now_ns - self._heard_ns > limits.idle_ns:
            return f"it has asked nothing for {limits.idle_ns / 1e9:g} s"
        return None

    def next_message(self) -> JsonObject | Unreadable | None:
        """The next whole message received, or why the next one cannot be read; None if there is none.

        `closing` is set if nothing after it can be read either, and once the peer has closed its side and
        everything it sent is read.
        """
        decoder = self.framed or self.bare
        message = None
        if decoder is not None and not self.closing:
            try:
                message = decoder.next_message()
            except BadMessageError as error:
                self._begun_ns = 0
                return Unreadable(str(error))
            except RemoteProtocolError as error:
                self.finish()
                return Unreadable(str(error))
        if isinstance(message, dict):  # the server's decoder gives no DATA
            self._heard_ns, self._begun_ns = time.monotonic_ns(), 0
            return message
        self.unread = False
        if decoder is not None and decoder.pending and not self._begun_ns:
            self._begun_ns = time.monotonic_ns()
        # One that has subscribed may have nothing more to say and still listen; if not, sending will tell.
        if self.end_of_input and self.subscription is None:
            self.finish()
        return None

    def finish(self) -> None:
        """Take nothing more from the peer; the connection is closed once everything is sent."""
        self.closing = True
        self.unread = False
        self.subscription = None

    # -- sending

    def send_json(self, message: JsonObject) -> None:
        """Send a reply or an event in this connection's own form."""
        if self.outbox.full:
            self.failed = True
            return
        self.outbox.send(encode_bare_json(message) if self.bare is not None else encode_json(message))

    def offer(self, frame: bytes, place: int, flags: int, now_ns: int) -> None:
        """Send a DATA frame if the subscription wants it."""
        wants = self.subscription
        if wants is None or not wants.wanted[place]:
            return
        if not flags and wants.every == 1 and not wants.gap[place]:
            withheld = self.outbox.send(frame, place)
            wants.last_ns[place] = now_ns
            if withheld >= 0:
                wants.gap[withheld] = True
            return
        if flags & _REPEATED and wants.fresh_only and now_ns - wants.last_ns[place] < _IDLE_FRAME_NS:
            return
        if flags & _GAP:
            wants.gap[place] = True
        if wants.skipped[place] < wants.every - 1:
            wants.skipped[place] += 1
            return
        wants.skipped[place] = 0
        wants.last_ns[place] = now_ns
        if wants.gap[place]:
            wants.gap[place] = False
            if not flags & _GAP:
                frame = with_gap(frame)
        withheld = self.outbox.send(frame, place)
        if withheld >= 0:
            wants.gap[withheld] = True

    def end_sending(self) -> None:
        """Tell the peer that nothing more comes; what it still sends is read and thrown away."""
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Close the socket."""
        self.sock.close()


def _address_text(sock: socket.socket) -> str:
    try:
        return str(Address(*sock.getpeername()[:2]))
    except OSError:
        return "unknown"
