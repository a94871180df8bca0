"""What waits to be sent to one client: a bounded queue of whole messages.

Sending never blocks. What cannot be sent at once waits; when too much waits the oldest DATA goes, never part
of a frame and never a reply.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from typing import Final

from protocol.framing import DATA_FLAGS_OFFSET, DataFlag

MAX_QUEUED_DATA: Final = 256
MAX_QUEUED_JSON: Final = 64
"""Replies and events that may wait; a client that asks and never reads is closed at this many."""

NO_PLACE: Final = -1
_GAP: Final = int(DataFlag.GAP)


class Outbox:
    """The sending side of the non-blocking `sock`."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self.sent = 0
        """DATA frames sent."""
        self.withheld = 0
        """DATA frames dropped because the client did not read."""
        self.broken = False
        """The socket takes nothing any more."""
        self.waiting = False
        """Something waits: `flush` when the socket is writable."""
        self.took_ns = 0
        """CLOCK_MONOTONIC when the socket last took something, while something waits."""
        self._queue: deque[tuple[bytes, int]] = deque()  # message, sensor place or NO_PLACE for JSON
        self._queued_data = 0
        self._head_sent = 0

    @property
    def replies_waiting(self) -> int:
        """How many messages other than DATA wait."""
        return len(self._queue) - self._queued_data

    def send(self, message: bytes, place: int = NO_PLACE) -> int:
        """Send a message, or have it wait; `place` is the sensor's if it is a DATA frame.

        Returns the place of the sensor whose next frame must carry GAP because one was withheld, or NO_PLACE.
        """
        if not self._queue:
            try:
                sent = self._sock.send(message)
            except BlockingIOError:
                sent = 0
            except OSError:
                self.broken = True
                return NO_PLACE
            if sent == len(message):
                if place >= 0:
                    self.sent += 1
                return NO_PLACE
            self._head_sent = sent
            self.waiting = True
            self.took_ns = time.monotonic_ns()
        self._queue.append((message, place))
        if place >= 0:
            self._queued_data += 1
            if self._queued_data > MAX_QUEUED_DATA:
                return self._drop_oldest_data()
        return NO_PLACE

    def flush(self) -> None:
        """Send what waits, as far as the socket takes it."""
        while self._queue:
            message, place = self._queue[0]
            try:
                sent = self._sock.send(memoryview(message)[self._head_sent :])
            except BlockingIOError:
                return
            except OSError:
                self.broken = True
                return
            self._head_sent += sent
            self.took_ns = time.monotonic_ns()
            if self._head_sent < len(message):
                return
            self._queue.popleft()
            self._head_sent = 0
            if place >= 0:
                self.sent += 1
                self._queued_data -= 1
        self.waiting = False

    def _drop_oldest_data(self) -> int:
        first = 1 if self._head_sent else 0  # a frame that is partly sent must go out whole
        for position in range(first, len(self._queue)):
            place = self._queue[position][1]
            if place < 0:
                continue
            del self._queue[position]
            self._queued_data -= 1
            self.withheld += 1
            for later in range(position, len(self._queue)):
                frame, its_place = self._queue[later]
                if its_place == place:
                    self._queue[later] = (with_gap(frame), place)
                    return NO_PLACE
            return place
        return NO_PLACE


def with_gap(frame: bytes) -> bytes:
    """A copy of an encoded DATA frame with the GAP flag set."""
    flags = frame[DATA_FLAGS_OFFSET] | _GAP
    return frame[:DATA_FLAGS_OFFSET] + bytes((flags,)) + frame[DATA_FLAGS_OFFSET + 1 :]
