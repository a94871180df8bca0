"""A small blocking client for programs that are not on ROS.

    from protocol.client import connect

    with connect(12001) as sensor:
        for sample in sensor:
            print(sample.force, sample.torque)

For one thread. Iterating leaves out REPEATED and INVALID frames, so no sample is returned twice. If it is
read more slowly than the sensor samples, the server withholds samples and sets GAP in `frame.flags`;
`receive` returns all that has arrived, the newest last.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any, Final

from protocol.accounting import NOT_NEW
from protocol.client.connection import CONNECT_TIMEOUT_S, FramedConnection
from protocol.client.real_time import Scheduling, make_real_time
from protocol.control import Event, check_version, request
from protocol.errors import ConnectionFailedError, NoReplyError, RefusedError
from protocol.framing import DataMessage
from protocol.pdo import LAYOUTS, ImuUnits, Sample, SampleDecoder
from protocol.text.json_text import JsonObject

ANSWER_TIMEOUT_S: Final = 5.0
_MOST_EVENTS: Final = 1000
_MOST_FRAMES: Final = 65536
"""Maximum number of frames buffered while waiting for a reply; a tare of 20,000 samples needs fewer."""
_MOST_READS: Final = 64
"""Maximum number of reads in one `receive`, so that it returns whatever arrives."""


def connect(
    port: int,
    host: str = "localhost",
    *,
    sensors: Sequence[int] | None = None,
    every: int = 1,
    fresh_only: bool = True,
    imu_units: ImuUnits = ImuUnits.G_DPS,
    rt_priority: int = 0,
    cpu: int = -1,
) -> Client:
    """Connect and subscribe: `sensors` by position on the bus, None for all; one frame in `every`.

    `rt_priority` and `cpu` are the calling thread's (`make_real_time`); `scheduling` has what was granted.

    UnreachableError where there is no server, RefusedError if it does not grant the subscription.
    """
    client = Client(port, host, imu_units=imu_units)
    try:
        client.scheduling = make_real_time(rt_priority, cpu)
        client.subscribe(sensors, every=every, fresh_only=fresh_only)
    except BaseException:
        client.close()
        raise
    return client


class Client:
    """A connection to the server: its stream, requests and events.

    Attributes:
        description: the reply to `describe`; after `subscribe` that reply, which says the same.
        events: the server's events, oldest first, the last thousand; take them out with `popleft`.
        frame: the DATA message that the last sample came from: its sequence, stamps, sensor, flags.
        scheduling: what `connect` was granted of `rt_priority` and `cpu`.
    """

    def __init__(
        self,
        port: int,
        host: str = "localhost",
        *,
        timeout_s: float = CONNECT_TIMEOUT_S,
        imu_units: ImuUnits = ImuUnits.G_DPS,
    ) -> None:
        """Connect and have the server describe itself; no stream yet.

        UnreachableError where there is no server; ConnectionFailedError if it speaks another protocol.
        """
        self.events: deque[JsonObject] = deque(maxlen=_MOST_EVENTS)
        self.frame: DataMessage | None = None
        self.scheduling = Scheduling()
        self._frames: deque[DataMessage] = deque(maxlen=_MOST_FRAMES)
        self._decoders = {size: SampleDecoder(size, imu_units) for size in LAYOUTS}
        self._asked = 0
        self._replies: list[JsonObject] = []
        self._ending = False
        self.connection = FramedConnection(host, port, timeout_s)
        try:
            self.description = self.ask("describe")
            check_version(self.description)
            self.connection.take_description(self.description)
        except BaseException:
            self.connection.close()
            raise

    def __enter__(self) -> Client:
        """The client; `with` closes it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; also from another thread, which ends a wait."""
        self.connection.close()

    def fileno(self) -> int:
        """For `select`: readable when something has arrived."""
        return self.connection.fileno()

    def ask(self, action: str, timeout_s: float = ANSWER_TIMEOUT_S, **values: object) -> JsonObject:
        """The reply that grants a request; frames on the way are kept for later.

        RefusedError if it is refused, ConnectionFailedError if no reply comes in `timeout_s`.
        """
        self._asked += 1
        self._replies.clear()
        self.connection.send(request(action, self._asked, **values))
        deadline = time.monotonic() + timeout_s
        while not self._replies:
            if not self.connection.wait(deadline - time.monotonic()):
                raise NoReplyError(f"no reply to {action} within {timeout_s:g} s")
            try:
                self._take()
            except ConnectionFailedError:
                if not self._replies:
                    raise
        reply = self._replies.pop()
        if reply.get("ok") is not True:
            raise RefusedError.of(reply)
        return reply

    def subscribe(
        self, sensors: Sequence[int] | None = None, *, every: int = 1, fresh_only: bool = True
    ) -> JsonObject:
        """Start the stream; returns the server's description. RefusedError if there is no such sensor."""
        values: dict[str, Any] = {"every": every, "fresh_only": fresh_only}
        if sensors is not None:
            values["sensors"] = list(sensors)
        self.description = self.ask("subscribe", **values)
        return self.description

    def receive(self, timeout_s: float) -> list[DataMessage]:
        """All frames that have arrived, waiting at most `timeout_s` for the first; none is left out.

        Returns at once when events have come. ConnectionFailedError when the connection is over and every
        frame has been handed out.
        """
        if self._frames:
            timeout_s = 0.0
        try:
            if self.connection.wait(timeout_s):
                self._take()
        except ConnectionFailedError:
            if not self._frames:
                raise
        frames = list(self._frames)
        self._frames.clear()
        return frames

    def frames(self) -> Iterator[DataMessage]:
        """Every frame as it comes, also REPEATED and INVALID ones, until the server shuts down.

        ConnectionFailedError if the connection ends otherwise.
        """
        while True:
            while self._frames:
                yield self._frames.popleft()
            try:
                if self.connection.receive() is not None:
                    self._sort()
            except ConnectionFailedError:
                if self._frames:
                    continue
                if self._ending:
                    return
                raise

    def __iter__(self) -> Iterator[Sample]:
        """Every new and valid sample as it comes, decoded; ends as `frames` does."""
        decoders = self._decoders
        for frame in self.frames():
            if not frame.flags & NOT_NEW:
                self.frame = frame
                yield decoders[len(frame.process_data)].decode(frame.process_data)

    def decode(self, frame: DataMessage) -> Sample:
        """The sample in `frame`."""
        return self._decoders[len(frame.process_data)].decode(frame.process_data)

    def _take(self) -> None:
        """Take all that has arrived."""
        for _ in range(_MOST_READS):
            more = self.connection.receive(wait=False)
            self._sort()
            if not more:
                break

    def _sort(self) -> None:
        """Sort what has been received into frames, events and replies."""
        while (message := self.connection.next_message()) is not None:
            if isinstance(message, DataMessage):
                self._frames.append(message)
            elif "event" in message:
                self._ending = self._ending or message["event"] == Event.SHUTTING_DOWN
                self.events.append(message)
            elif message.get("id") in (self._asked, None):  # None: it could not read the request
                self._replies.append(message)
