"""One client's connection: its state, what it has sent so far, which DATA it wants. It never blocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Final, NamedTuple

from bota_ethercat.errors import BadMessageError, RemoteProtocolError
from bota_ethercat.framing import DATA_FLAGS_OFFSET, DataFlag, FrameDecoder, MessageType, encode_json
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.serving.bare_json import BARE_JSON_FIRST_BYTE, BareJsonDecoder, encode_bare_json
from ethercat_server.serving.transport import Stream

MAX_REQUEST_LENGTH: Final = 4096
MAX_QUEUED_DATA: Final = 256
MAX_QUEUED_JSON: Final = 64
# Limits of the replies and events that wait; a client that asks and never reads is closed at them.
MAX_QUEUED_JSON_BYTES: Final = 262_144

NO_SENSOR: Final = -1
# A `fresh_only` client gets a REPEATED frame only if it has received nothing for this long.
_IDLE_FRAME_NS: Final = 10_000_000
_REPEATED: Final = int(DataFlag.REPEATED)
_GAP: Final = int(DataFlag.GAP)
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
        if flags & _GAP:
            self.gaps.add(number)
        if self.skipped[number] < self.every - 1:
            self.skipped[number] += 1
            return None
        self.skipped[number] = 0
        if number in self.gaps:
            self.gaps.discard(number)
            if not flags & _GAP:
                frame = with_gap(frame)
        self._chosen_ns[number] = now_ns
        return frame, number, flags, newest_ns


class Outbox:
    """The send queue of a connection: bounded, of whole messages.

    Sending never blocks. What cannot be sent at once is queued; a full queue drops the oldest DATA frame,
    never part of a frame and never a reply.
    """

    def __init__(self, stream: Stream, clock_ns: Callable[[], int], writers: set[int]) -> None:
        """`writers` has the descriptor of the stream while something waits."""
        self._send, self._fd, self._writers = stream.send, stream.fileno(), writers
        self._clock_ns = clock_ns
        self.sent = 0  # DATA frames sent
        self.withheld = 0  # DATA frames dropped because the client did not read
        self.broken = False  # sending has failed for good; everything is discarded from then on
        # CLOCK_MONOTONIC when the socket last accepted something, while something is queued.
        self.progress_ns = 0
        self._queue: deque[tuple[bytes, int]] = deque()  # message, sensor's number or NO_SENSOR for JSON
        self._queued_data = 0
        self._queued_json_bytes = 0
        self._head_sent = 0

    @property
    def waiting(self) -> bool:
        """Something is queued: `flush` when the socket is writable."""
        return bool(self._queue)

    @property
    def full(self) -> bool:
        """Whether the limit of queued replies and events is reached."""
        replies = len(self._queue) - self._queued_data
        return replies >= MAX_QUEUED_JSON or self._queued_json_bytes > MAX_QUEUED_JSON_BYTES

    def send(self, message: bytes) -> None:
        """Send a reply or an event, or queue it."""
        if not self._queue:
            try:
                sent = self._send(message)
            except OSError as error:
                sent = self._refused(error)
            if sent == len(message) or self.broken:
                return
            self._wait()
            self._head_sent = sent
        self._queue.append((message, NO_SENSOR))
        self._queued_json_bytes += len(message)

    def send_data(self, frames: Sequence[OutgoingFrame]) -> Sequence[int]:
        """Send DATA frames, one of a sensor, or queue them.

        Returns the sensors whose next frame must carry GAP because one was dropped.
        """
        if not self._queue:
            message = frames[0][0] if len(frames) == 1 else b"".join([each[0] for each in frames])
            try:
                sent = self._send(message)
            except OSError as error:
                sent = self._refused(error)
            if sent == len(message):
                self.sent += len(frames)
                return ()
            if self.broken:
                return ()
            self._wait()
            whole = 0
            while sent >= (size := len(frames[whole][0])):
                sent -= size
                whole += 1
            self.sent += whole
            frames = frames[whole:]
            self._head_sent = sent
        dropped: set[int] = set()
        for frame, number, _, _ in frames:
            self._queue.append((with_gap(frame) if number in dropped else frame, number))
            dropped.discard(number)
            self._queued_data += 1
            if self._queued_data > MAX_QUEUED_DATA:
                dropped.add(self._drop_oldest_data())
        return tuple(dropped - {NO_SENSOR})

    def _refused(self, error: OSError) -> int:
        """The socket accepts nothing: not now, or never again."""
        if not isinstance(error, BlockingIOError):
            self.broken = True
            self._writers.discard(self._fd)
            self._queue.clear()
            self._queued_data = self._queued_json_bytes = self._head_sent = 0
        return 0

    def _wait(self) -> None:
        self._writers.add(self._fd)
        self.progress_ns = self._clock_ns()

    def flush(self) -> None:
        """Send what is queued, as far as the socket accepts it."""
        while self._queue:
            message, number = self._queue[0]
            try:
                sent = self._send(memoryview(message)[self._head_sent :])
            except OSError as error:
                self._refused(error)
                return
            self._head_sent += sent
            self.progress_ns = self._clock_ns()
            if self._head_sent < len(message):
                return
            self._queue.popleft()
            self._head_sent = 0
            if number >= 0:
                self.sent += 1
                self._queued_data -= 1
            else:
                self._queued_json_bytes -= len(message)
        self._writers.discard(self._fd)

    def _drop_oldest_data(self) -> int:
        first = 1 if self._head_sent else 0  # a frame that is partly sent must go out whole
        for at in range(first, len(self._queue)):
            number = self._queue[at][1]
            if number < 0:
                continue
            del self._queue[at]
            self._queued_data -= 1
            self.withheld += 1
            for later in range(at, len(self._queue)):
                frame, its_position = self._queue[later]
                if its_position == number:
                    self._queue[later] = (with_gap(frame), number)
                    return NO_SENSOR
            return number
        return NO_SENSOR


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
        self.outbox = Outbox(stream, clock_ns, self._watched.writers)
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
            if now_ns - self.outbox.progress_ns > timeouts.stall_ns:
                return f"it has read nothing for {timeouts.stall_ns / 1e9:g} s"
        elif self._begun_ns and now_ns - self._begun_ns > _INCOMPLETE_MESSAGE_NS:
            return f"its message is still incomplete after {_INCOMPLETE_MESSAGE_NS / 1e9:g} s"
        elif (
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


def with_gap(frame: bytes) -> bytes:
    """A copy of an encoded DATA frame with the GAP flag set."""
    flags = frame[DATA_FLAGS_OFFSET] | _GAP
    return frame[:DATA_FLAGS_OFFSET] + bytes((flags,)) + frame[DATA_FLAGS_OFFSET + 1 :]
