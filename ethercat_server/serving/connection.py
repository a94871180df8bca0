"""One client's connection: its state, what it has sent so far, which DATA it wants. It never blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum
from typing import Final, NamedTuple

from bota_ethercat.errors import BadMessageError, RemoteProtocolError
from bota_ethercat.framing import MAX_REQUEST_LENGTH, DataFlag, FrameDecoder, MessageType, encode_json
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.serving.bare_json import BARE_JSON_FIRST_BYTE, BareJsonDecoder, encode_bare_json
from ethercat_server.serving.send_queue import GAP, SendQueue, with_gap
from ethercat_server.serving.transport import Stream

# A `fresh_only` client gets a REPEATED frame only if it has received nothing for this long.
_IDLE_FRAME_NS: Final = 10_000_000
_REPEATED: Final = int(DataFlag.REPEATED)
_INCOMPLETE_MESSAGE_NS: Final = (
    10_000_000_000  # timeout for the rest of a message whose first part has arrived
)
_LAST_REPLY_NS: Final = 1_000_000_000  # timeout for a connection that is being closed


class ConnectionState(Enum):
    """What a connection does now."""

    READING = "waits for the client's next request, if the client has not closed its side"
    READY = "has received bytes that may contain whole requests; reads no more until they are taken"
    ANSWERING = "its last request is not answered yet; what the client sent after it waits"
    CLOSING = "sends what waits and discards what the client still sends"
    LINGERING = "everything is sent and this side is closed; discards until the client has closed its own"
    CLOSED = "nothing is left but to close the socket"

    def __init__(self, _meaning: str) -> None:
        # Read for every connection in each turn: an attribute costs less than looking a member up in a set.
        # Whether no more requests are taken.
        self.ending = self.name in {"CLOSING", "LINGERING", "CLOSED"}


_S = ConnectionState
# Any other is a defect of this program.
TRANSITIONS: Final = {
    _S.READING: {_S.READY, _S.CLOSING, _S.CLOSED},
    _S.READY: {_S.READING, _S.ANSWERING, _S.CLOSING, _S.CLOSED},
    _S.ANSWERING: {_S.READY, _S.CLOSING, _S.CLOSED},
    _S.CLOSING: {_S.LINGERING, _S.CLOSED},
    _S.LINGERING: {_S.CLOSED},
    _S.CLOSED: set[ConnectionState](),
}


class Timeouts(NamedTuple):
    """Timeouts after which a client is closed."""

    stall_ns: float = 10e9  # while something waits to be sent: nothing of it was accepted
    idle_ns: float = 300e9  # without a subscription: no request


class Unreadable(NamedTuple):
    """A message that could not be read.

    Not an exception: its traceback would refer to itself, and the garbage collector is off in the loop.
    """

    reason: str


class DataSubscription:
    """Which DATA a client wants. Lists are by the sensor's number; the terminals follow."""

    def __init__(self, wanted: Sequence[bool], every: int, fresh_only: bool, now_ns: int) -> None:
        self.wanted = wanted
        self.every = every
        # Whether it leaves out frames that have no flag.
        self.chooses = every != 1 or not all(wanted)
        self.fresh_only = fresh_only
        self.skipped = [every - 1] * len(wanted)
        self._since_ns = now_ns
        # When the last frame that `choose` let pass was sent; long ago even if the clock starts at zero.
        self._chosen_ns = [-_IDLE_FRAME_NS] * len(wanted)
        self.gaps: set[int] = set()  # sensors whose next frame must carry GAP

    def choose(self, made: Sequence[OutgoingFrame], now_ns: int) -> list[OutgoingFrame]:
        """What it gets of some DATA frames, of which at least one is not like most."""
        return [chosen for each in made if (chosen := self._choose(*each, now_ns)) is not None]

    def _choose(
        self, frame: bytes, number: int, flags: int, newest_ns: int, now_ns: int
    ) -> OutgoingFrame | None:
        if not self.wanted[number]:
            return None
        if flags & _REPEATED and self.fresh_only:
            had_ns = self._chosen_ns[number]
            if newest_ns >= self._since_ns and not self.chooses:  # that was sent, too
                had_ns = max(had_ns, newest_ns)
            if now_ns - had_ns < _IDLE_FRAME_NS:
                return None
        if flags & GAP:
            self.gaps.add(number)
        if self.skipped[number] < self.every - 1:
            self.skipped[number] += 1
            return None
        self.skipped[number] = 0
        if number in self.gaps:
            self.gaps.discard(number)
            if not flags & GAP:
                frame = with_gap(frame)
        self._chosen_ns[number] = now_ns
        return frame, number, flags, newest_ns


class Watched(NamedTuple):
    """File descriptors to wait for; each connection adds and removes its own."""

    readers: set[int]
    writers: set[int]


class Connection:
    """A client's stream and everything that belongs to it."""

    def __init__(
        self, stream: Stream, uid: int | None, clock_ns: Callable[[], int], watched: Watched
    ) -> None:
        """`uid` is the user who owns the other end, None if that is not known."""
        self.fd = stream.fileno()
        self.peer = stream.peer
        self.uid = uid
        self.state = ConnectionState.READING
        self.framed: FrameDecoder | None = None
        self.bare: BareJsonDecoder | None = None
        self.subscription: DataSubscription | None = None
        self._watched = watched
        self._watched.readers.add(self.fd)
        self.outbox = SendQueue(stream, clock_ns, self._watched.writers)
        self._stream = stream
        self._clock_ns = clock_ns
        self._heard_ns = clock_ns()
        self._client_ended = False  # it has closed its side, and may still receive
        self._begun_ns = 0  # since when the rest of an unfinished message is awaited; 0 if there is none
        self._ending_ns = 0  # since when the connection is being closed

    def __str__(self) -> str:
        """For the log. The user by number: looking up a name can require a directory server."""
        return f"client {self.peer} (uid {'unknown' if self.uid is None else self.uid})"

    def _become(self, state: ConnectionState) -> None:
        if state not in TRANSITIONS[self.state]:
            raise AssertionError(f"{self}: {self.state.name} -> {state.name}")
        self.state = state
        if self._client_ended or state in (_S.READY, _S.ANSWERING, _S.CLOSED):
            self._watched.readers.discard(self.fd)
        else:
            self._watched.readers.add(self.fd)

    @property
    def is_idle(self) -> bool:
        """Whether it has no subscription, and no request that is not answered."""
        return self.subscription is None and self.state is ConnectionState.READING and not self.outbox.waiting

    def find_uid(self) -> int | None:
        """The user who owns the other end; asked again if that was not known."""
        if self.uid is None:
            self.uid = self._stream.peer_uid()
        return self.uid

    # -- receiving

    def receive(self) -> None:
        """Read what has arrived, at most one request's worth; READY then means to call `next_message`."""
        try:
            data = self._stream.recv(MAX_REQUEST_LENGTH)
        except BlockingIOError:
            return
        except OSError:
            self.fail()
            return
        if data:
            # Once it is being closed what comes is discarded, so that this does not reset the connection
            # before the last reply is read.
            if not self.state.ending:
                self._feed(data)
                self._become(ConnectionState.READY)
        elif self.state is ConnectionState.READING and self.bare is not None and self.bare.pending:
            self.bare.end_of_input()
            self._become(ConnectionState.READY)
        else:
            self._client_ended = True
            self._watched.readers.discard(self.fd)
            if self.state is ConnectionState.LINGERING:
                self._become(ConnectionState.CLOSED)
            elif self.subscription is None:
                self.finish()

    def _feed(self, data: bytes) -> None:
        decoder = self.framed or self.bare
        if decoder is None:
            if data.startswith(BARE_JSON_FIRST_BYTE):
                decoder = self.bare = BareJsonDecoder(max_json_length=MAX_REQUEST_LENGTH)
            else:
                decoder = self.framed = FrameDecoder(
                    max_json_length=MAX_REQUEST_LENGTH, accepts=(MessageType.JSON,)
                )
        decoder.feed(data)

    def next_message(self) -> JsonObject | Unreadable | None:
        """In READY, the next request, or why it cannot be read; None if there is no whole one.

        After it the connection is still READY, or READING if there was none, or CLOSING if nothing after it
        can be read either.
        """
        decoder = self.framed or self.bare
        assert decoder is not None
        try:
            message = decoder.next_message()
        except BadMessageError as error:
            self._begun_ns = 0
            return Unreadable(str(error))
        except RemoteProtocolError as error:
            self.finish()
            return Unreadable(str(error))
        if isinstance(message, dict):  # this decoder accepts no DATA
            self._heard_ns, self._begun_ns = self._clock_ns(), 0
            return message
        self._become(ConnectionState.READING)
        if decoder.pending and not self._begun_ns:
            self._begun_ns = self._clock_ns()
        return None

    def subscribe(self, wanted: Sequence[bool], every: int, fresh_only: bool) -> None:
        """Begin to take DATA, or change which."""
        self.subscription = DataSubscription(wanted, every, fresh_only, self._clock_ns())

    def answer_later(self) -> None:
        """The request that was taken is answered later: `answered` then. It may have ended the connection."""
        if not self.state.ending:
            self._become(ConnectionState.ANSWERING)

    def answered(self) -> None:
        """Go on with what the client sent after the request; it is idle from now on."""
        self._heard_ns = self._clock_ns()
        self._become(ConnectionState.READY)

    # -- ending

    def reason_to_close(self, now_ns: int, timeouts: Timeouts) -> str | None:
        """Why this client is to be closed, None if it is not."""
        if self.state.ending:
            return None
        if self.outbox.waiting:
            return self.outbox.why_too_slow(now_ns, timeouts.stall_ns)
        if self._begun_ns and now_ns - self._begun_ns > _INCOMPLETE_MESSAGE_NS:
            return f"its message is still incomplete after {_INCOMPLETE_MESSAGE_NS / 1e9:g} s"
        if (
            self.subscription is None
            and self.state is not ConnectionState.ANSWERING
            and now_ns - self._heard_ns > timeouts.idle_ns
        ):
            return f"it is not subscribed and has sent no request for {timeouts.idle_ns / 1e9:g} s"
        return None

    def finish(self) -> None:
        """Accept no more requests and close once everything is sent."""
        if not self.state.ending:
            self._end()

    def fail(self) -> None:
        """Close at once: the connection is broken, or the client is beyond a limit."""
        if self.state is not ConnectionState.CLOSED:
            self._become(ConnectionState.CLOSED)
            self.subscription = None

    def settle(self, now_ns: int) -> None:
        """Go on with closing, to be called now and then."""
        too_long = self.state.ending and now_ns - self._ending_ns > _LAST_REPLY_NS
        if too_long or self.outbox.broken:
            self.fail()
        elif self.state is ConnectionState.CLOSING and not self.outbox.waiting:
            if not self._client_ended:
                self._stream.end_sending()
            self._become(ConnectionState.CLOSED if self._client_ended else ConnectionState.LINGERING)

    def close(self) -> None:
        """Close the stream."""
        for descriptors in self._watched:
            descriptors.discard(self.fd)
        self._stream.close()

    def _end(self) -> None:
        self._become(ConnectionState.CLOSING)
        self.subscription = None
        self._ending_ns = self._clock_ns()

    # -- sending

    def send_json(self, message: JsonObject) -> None:
        """Send a reply or an event in this connection's own form."""
        if self.state in (ConnectionState.LINGERING, ConnectionState.CLOSED):
            return
        if self.outbox.full:
            self.fail()
            return
        self.outbox.send(encode_bare_json(message) if self.bare is not None else encode_json(message))

    def offer(self, made: Sequence[OutgoingFrame], flags: int, now_ns: int) -> None:
        """Send those DATA frames that the subscription wants, at once; `flags` are those of all of them."""
        if (wants := self.subscription) is None:
            return
        if (flags or wants.chooses or wants.gaps) and not (made := wants.choose(made, now_ns)):
            return
        wants.gaps.update(self.outbox.send_data(made))
