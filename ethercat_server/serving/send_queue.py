"""The send queue of a connection: what is dropped if its client is too slow, when it is closed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from bota_ethercat.framing import DATA_FLAGS_OFFSET, DataFlag
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.serving.transport import Stream

MAX_QUEUED_DATA: Final = 256
MAX_QUEUED_JSON: Final = 64
# Limits of the replies and events that wait; a client that asks and never reads is closed at them.
MAX_QUEUED_JSON_BYTES: Final = 262_144

NO_SENSOR: Final = -1
GAP: Final = int(DataFlag.GAP)


def with_gap(frame: bytes) -> bytes:
    """A copy of an encoded DATA frame with the GAP flag set."""
    flags = frame[DATA_FLAGS_OFFSET] | GAP
    return frame[:DATA_FLAGS_OFFSET] + bytes((flags,)) + frame[DATA_FLAGS_OFFSET + 1 :]


class SendQueue:
    """What is sent to a client: bounded, of whole messages.

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

    def why_too_slow(self, now_ns: int, stall_ns: float) -> str | None:
        """Why its client is to be closed, None if it is not: it does not take what waits."""
        stalled = now_ns - self.progress_ns > stall_ns
        return f"it has read nothing for {stall_ns / 1e9:g} s" if stalled else None

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
