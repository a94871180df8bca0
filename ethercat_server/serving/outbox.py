"""The send queue of one client: bounded, of whole messages.

Sending never blocks. What cannot be sent at once is queued; a full queue drops the oldest DATA frame, never
part of a frame and never a reply.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from ethercat_server.serving.transport.base import Stream
from protocol.framing import DATA_FLAGS_OFFSET, DataFlag

MAX_QUEUED_DATA: Final = 256
MAX_QUEUED_JSON: Final = 64
MAX_QUEUED_JSON_BYTES: Final = 262_144
"""Limits of the replies and events that wait; a client that asks and never reads is closed at them."""

NO_SENSOR: Final = -1
_GAP: Final = int(DataFlag.GAP)


class Outbox:
    """The sending side of a connection."""

    def __init__(self, stream: Stream, monotonic_ns: Callable[[], int]) -> None:
        self._send = stream.send
        self._monotonic_ns = monotonic_ns
        self.sent = 0
        """DATA frames sent."""
        self.withheld = 0
        """DATA frames dropped because the client did not read."""
        self.broken = False
        """Sending has failed for good; everything is discarded from then on."""
        self.waiting = False
        """Something is queued: `flush` when the socket is writable."""
        self.progress_ns = 0
        """CLOCK_MONOTONIC when the socket last accepted something, while something is queued."""
        self._queue: deque[tuple[bytes, int]] = deque()  # message, sensor's number or NO_SENSOR for JSON
        self._queued_data = 0
        self._queued_json_bytes = 0
        self._head_sent = 0

    @property
    def full(self) -> bool:
        """Whether the limit of queued replies and events is reached."""
        replies = len(self._queue) - self._queued_data
        return replies >= MAX_QUEUED_JSON or self._queued_json_bytes > MAX_QUEUED_JSON_BYTES

    def send(self, message: bytes, number: int = NO_SENSOR) -> int:
        """Send a message or queue it; `number` is the sensor's number if it is a DATA frame.

        Returns the number of the sensor whose next frame must carry GAP because one was dropped, if any.
        """
        if not self._queue:
            try:
                sent = self._send(message)
            except BlockingIOError:
                sent = 0
            except OSError:
                self._break()
                return NO_SENSOR
            if sent == len(message):
                if number >= 0:
                    self.sent += 1
                return NO_SENSOR
            self._head_sent = sent
            self.waiting = True
            self.progress_ns = self._monotonic_ns()
        self._queue.append((message, number))
        if number < 0:
            self._queued_json_bytes += len(message)
        else:
            self._queued_data += 1
            if self._queued_data > MAX_QUEUED_DATA:
                return self._drop_oldest_data()
        return NO_SENSOR

    def flush(self) -> None:
        """Send what is queued, as far as the socket accepts it."""
        while self._queue:
            message, number = self._queue[0]
            try:
                sent = self._send(memoryview(message)[self._head_sent :])
            except BlockingIOError:
                return
            except OSError:
                self._break()
                return
            self._head_sent += sent
            self.progress_ns = self._monotonic_ns()
            if self._head_sent < len(message):
                return
            self._queue.popleft()
            self._head_sent = 0
            if number >= 0:
                self.sent += 1
                self._queued_data -= 1
            else:
                self._queued_json_bytes -= len(message)
        self.waiting = False

    def _break(self) -> None:
        self.broken = True
        self.waiting = False
        self._queue.clear()
        self._queued_data = self._queued_json_bytes = self._head_sent = 0

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


def with_gap(frame: bytes) -> bytes:
    """A copy of an encoded DATA frame with the GAP flag set."""
    flags = frame[DATA_FLAGS_OFFSET] | _GAP
    return frame[:DATA_FLAGS_OFFSET] + bytes((flags,)) + frame[DATA_FLAGS_OFFSET + 1 :]
