# SPDX-License-Identifier: Apache-2.0
"""The client's side of the protocol without sockets: bytes in; samples, replies and events out.

The rules it keeps:

- A connection begins with `describe`: the version is checked, and of the sensors asked for, those that are
  there are subscribed to. If none is there, or at first not all are, the connection has failed.
- The owner of the socket passes what arrives to `received` and sends what is returned.
- After a connection that ended the next attempt is due at `retry_at_ns`: later each time, and soon after one
  that lasted.
- What is known of a sensor is kept over connections; the first sample of a new one has GAP.
- What is in force for a sensor is folded by one `Timeline`, in the order in which it came, whoever asked.
- Frames that are no news are not handed out, unless `raw`.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Final, NamedTuple

from bota_ethercat.address import boot_id
from bota_ethercat.client.reading import ReceivedSensor
from bota_ethercat.control import check_version, request
from bota_ethercat.errors import (
    BadMessageError,
    ConnectionFailedError,
    NoReplyError,
    RefusedError,
    RemoteProtocolError,
)
from bota_ethercat.framing import (
    DataFlag,
    DataMessage,
    FrameDecoder,
    SingleData,
    TerminalMessage,
    encode_json,
)
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import Description
from bota_ethercat.stream.timeline import InForce, Timeline
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable, rows

_MIN_RETRY_NS: Final = 100_000_000
_MAX_RETRY_NS: Final = 1_000_000_000
# After a connection that lasted this long the next attempt follows as soon as after the first.
_LASTED_NS: Final = 1_000_000_000
_MAX_ITEMS: Final = 65536  # kept until they are taken; a tare of 20,000 samples needs fewer
_HANDSHAKE_NS: Final = 5_000_000_000
_MIN_TIMEOUT_S: Final = 0.02
_TIMEOUT_PERIODS: Final = 5


class Connected(NamedTuple):
    """A connection was made, and what was asked for is granted."""

    description: JsonObject
    again: bool  # it is not the first
    missing: tuple[int, ...]  # sensors that were asked for and are not there


class Disconnected(NamedTuple):
    """A connection has ended, or an attempt to make one has failed."""

    reason: str
    reachable: bool  # there is a server
    was_connected: bool


# What the client tells of its connection, and the server's events as they came.
ClientEvent = Connected | Disconnected | JsonObject
Item = DataMessage | ClientEvent | InForce


class Session:
    """The conversation with one server, over any number of connections.

    Attributes:
        connected: whether there is a connection and its subscription is granted.
        description: the server's newest description; empty before the first connection.
        items: what has arrived and was not taken yet, in order: new and valid frames, or all of them if
            `raw`; the server's events; `Connected` and `Disconnected`; and where something changes what is in
            force for a sensor, `InForce` behind what says it.
        timeline: what is in force after all that was received, taken or not.
        terminal_frames: the last thousand of terminals, likewise.
        same_machine: whether the server's CLOCK_MONOTONIC is this machine's.
        sensors: by position on the bus.
        connections: number of those that were made.
        retry_at_ns: the next attempt is due at this CLOCK_MONOTONIC.
        problem: why there is no connection; empty if there is one.
    """

    def __init__(
        self,
        sensors: Sequence[int] | None = None,
        *,
        every: int = 1,
        fresh_only: bool = True,
        raw: bool = False,
        stream: bool = True,
        imu_units: ImuUnits = ImuUnits.G_DPS,
        terminals: Sequence[int] = (),
    ) -> None:
        """What to subscribe to, `sensors` None for all; nothing unless `stream`."""
        self.wanted = None if sensors is None else tuple(sensors)
        self._terminals = list(terminals)
        self.terminal_frames: deque[TerminalMessage] = deque(maxlen=_MAX_ITEMS // 64)
        self.connected = self.same_machine = False
        self.description: JsonObject = {}
        self.items: deque[Item] = deque()
        self.timeline = Timeline()
        self._dropped: set[int] = set()  # sensors whose frames were dropped from `items`
        self.sensors: dict[int, ReceivedSensor] = {}
        self.connections = 0
        self.retry_at_ns = 0
        self.problem = "no connection yet"
        self._every, self._fresh_only, self._imu_units = every, fresh_only, imu_units
        self._raw, self._stream = raw, stream
        self._begun_ns = -1
        for sensor in self.wanted or ():
            self.state(sensor)
        self._decoder = FrameDecoder()
        self._batch: list[DataMessage] = []
        self._ids = itertools.count(1)
        self._replies: dict[int, Future[JsonObject]] = {}
        # The request that is to be granted next, and what its reply goes to.
        self._handshake: tuple[Future[JsonObject], Callable[[JsonObject], bytes]] | None = None
        self._missing: tuple[int, ...] = ()
        self._retry_ns = _MIN_RETRY_NS
        self._opened_ns = 0
        self._open = False

    # -- the connection

    def opened(self, now_ns: int, *, same_address: bool) -> bytes:
        """There is a connection; what to send. `same_address`: of both ends, as on one machine."""
        self._open, self._opened_ns = True, now_ns
        self.same_machine = same_address
        self._decoder = FrameDecoder()
        return self._ask_first(self._described, "describe")

    def ended(self, reason: str, now_ns: int, *, reachable: bool = True) -> None:
        """The connection has ended, or none could be made."""
        was_connected = self.connected
        if self._open and now_ns - self._opened_ns >= _LASTED_NS:
            self._retry_ns = _MIN_RETRY_NS
        self.connected = self._open = False
        self._handshake = None
        self.retry_at_ns = now_ns + self._retry_ns
        self._retry_ns = min(self._retry_ns * 3 // 2, _MAX_RETRY_NS)
        self.problem = reason
        error = ConnectionFailedError(f"the connection ended before the reply: {reason}")
        for identifier in list(self._replies):
            if (future := self._replies.pop(identifier, None)) is not None:
                future.set_exception(error)
        self.items.append(Disconnected(reason, reachable, was_connected))
        self._drop_oldest()

    def pop_items(self) -> list[Item]:
        """`items`, which are taken; GAP in the first frame of a sensor whose frames were dropped."""
        items = list(self.items)
        self.items.clear()
        if self._dropped:
            for at, item in enumerate(items):
                if isinstance(item, DataMessage) and item.sensor in self._dropped:
                    self._dropped.remove(item.sensor)
                    items[at] = item._replace(flags=item.flags | DataFlag.GAP)
        return items

    def _drop_oldest(self) -> None:
        """Nobody takes the items: their owner waits for a reply, say."""
        while len(self.items) > _MAX_ITEMS:
            item = self.items.popleft()
            if isinstance(item, DataMessage):
                self._dropped.add(item.sensor)

    def get_buffer(self) -> memoryview:
        """Where to read into; then call `received`."""
        return self._decoder.get_buffer()

    def single(self, frame: DataMessage) -> SingleData | None:
        """How to read messages of the size of this one; None while anything else is to be done first."""
        if self.items or self._raw or not self.connected:
            return None
        return self._decoder.single(len(frame.process_data))

    def received(self, count: int, now_ns: int) -> bytes:
        """`count` bytes were read into `get_buffer()`; what to send, almost always nothing.

        ProtocolError if the connection is of no use, RefusedError if the server does not grant what was asked
        for: close it and call `ended`.
        """
        if not count:
            if not self.connected and now_ns - self._opened_ns > _HANDSHAKE_NS:
                raise NoReplyError(f"no reply to describe within {_HANDSHAKE_NS / 1e9:g} s")
            return b""
        decoder, batch, answer = self._decoder, self._batch, b""
        decoder.received(count)
        try:
            while True:
                message = decoder.next_data(batch)
                if batch:
                    self._add_frames(now_ns)
                if message is None:
                    self._drop_oldest()
                    return answer
                if not isinstance(message, TerminalMessage):
                    answer += self._handle_json(message)
                elif self._raw or not message.flags & DataFlag.INVALID:
                    self.terminal_frames.append(message)
        except (RemoteProtocolError, BadMessageError) as error:
            raise ConnectionFailedError(f"what came is not this protocol: {printable(error)}") from None

    def _add_frames(self, now_ns: int) -> None:
        sensors, items, batch, same = self.sensors, self.items, self._batch, self.same_machine
        for frame in batch:
            state = sensors.get(frame.sensor)
            new = None
            if state is not None:
                is_lost = state.lost
                new = state.add(frame, now_ns, same)
                if is_lost and new is not None:
                    self._tell(self.timeline.sampled(frame.sensor))
            if self._raw:
                items.append(frame)
            elif new is not None:
                items.append(new)
        batch.clear()

    # -- requests

    def ask(self, action: str, **values: object) -> tuple[Future[JsonObject], bytes]:
        """A request: the future that gets its reply, and what to send; from any thread."""
        identifier = next(self._ids)
        future = self._replies[identifier] = Future[JsonObject]()
        future.set_running_or_notify_cancel()  # it cannot be cancelled: the request is sent
        return future, encode_json(request(action, identifier, **values))

    def forget(self, future: Future[JsonObject]) -> None:
        """Drop the reply to this request; from any thread."""
        for identifier, waiting in list(self._replies.items()):
            if waiting is future:
                self._replies.pop(identifier, None)

    def _handle_json(self, message: JsonObject) -> bytes:
        """Take a JSON message; what to send."""
        if "event" in message:
            if isinstance(message["event"], str):
                self.items.append(message)
                self._tell(self.timeline.event(message))
            return b""
        identifier = message.get("id")
        future = self._replies.pop(identifier, None) if type(identifier) is int else None
        if self.connected and message.get("reply") in ("describe", "subscribe") and message.get("ok") is True:
            self.description = message
            self._tell(self.timeline.describe(message))  # before who asked knows, and in its place
        if future is not None:
            future.set_result(message)
        if future is None or self._handshake is None or future is not self._handshake[0]:
            return b""
        check_granted(message)
        return self._handshake[1](message)

    def _ask_first(self, then: Callable[[JsonObject], bytes], action: str, **values: object) -> bytes:
        future, sent = self.ask(action, **values)
        self._handshake = future, then
        return sent

    def _described(self, reply: JsonObject) -> bytes:
        check_version(reply)
        theirs, ours = reply.get("boot_id"), boot_id()
        if isinstance(theirs, str) and ours is not None:
            self.same_machine = theirs == ours
        if not self._stream:
            return self._granted(reply)
        self.description = reply
        there = [info.sensor for info in Description.parse(reply).sensors]
        values: dict[str, Any] = {"every": self._every, "fresh_only": self._fresh_only}
        if self.wanted is not None:
            found = [position for position in self.wanted if position in there]
            self._missing = tuple(position for position in self.wanted if position not in there)
            if self._missing and not (found and self.connections):
                text = ", ".join(map(str, self._missing))
                has = ", ".join(map(str, there[:16])) or "none"
                raise ConnectionFailedError(f"the server has no sensor {text} (it has: {has})")
            values["sensors"] = found
        read = len(rows(self.description.get("terminals")))
        if terminals := [number for number in self._terminals if number < read]:
            values["terminals"] = terminals
        return self._ask_first(self._granted, "subscribe", **values)

    def _granted(self, reply: JsonObject) -> bytes:
        self.description = reply
        self._handshake = None
        self._begun_ns = -1
        for state in self.sensors.values():
            state.begin()
        self.connected, self.problem = True, ""
        self.connections += 1
        self.items.append(Connected(self.description, self.connections > 1, self._missing))
        self._tell(self.timeline.connected(reply))
        return b""

    def _tell(self, changed: list[InForce]) -> None:
        for in_force in changed:
            self.state(in_force.sensor).in_force = in_force
        self.items.extend(changed)

    # -- what is known

    @property
    def timeout_s(self) -> float:
        """After this time without a sample something is wrong: a few periods of the slowest sensor."""
        rates = [state.accounting.rate_hz for state in self.sensors.values() if state.accounting.rate_hz]
        return max([_MIN_TIMEOUT_S, *(_TIMEOUT_PERIODS * self._every / rate for rate in rates)])

    def state(self, sensor: int) -> ReceivedSensor:
        """What is known of a sensor, so far nothing of one that no description had."""
        if sensor not in self.sensors:
            self.sensors[sensor] = ReceivedSensor(
                sensor, every=self._every, fresh_only=self._fresh_only, imu_units=self._imu_units
            )
        return self.sensors[sensor]

    @property
    def first(self) -> int:
        """The sensor that is meant where none is named."""
        return self.wanted[0] if self.wanted else min(self.sensors, default=0)

    def find_silent(self, timeout_ns: int) -> int | None:
        """A sensor without new samples for this time, in which another had some; told again after it."""
        awaited = [self.sensors[position] for position in self.wanted or self.sensors]
        if len(awaited) < 2:
            return None
        newest_ns = max(state.accounting.new_ns for state in awaited)
        if self._begun_ns < 0:
            self._begun_ns = newest_ns
        for state in awaited:
            if newest_ns - max(state.accounting.new_ns, state.told_ns, self._begun_ns) >= timeout_ns:
                state.told_ns = newest_ns
                return state.sensor
        return None


def check_granted(reply: JsonObject) -> None:
    """RefusedError unless the server granted it."""
    if reply.get("ok") is not True:
        raise RefusedError.of(reply)
