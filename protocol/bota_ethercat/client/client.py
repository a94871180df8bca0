# SPDX-License-Identifier: Apache-2.0
"""The client for programs that are not on ROS; the node, the recorder and the monitor are built on it, too.

    from bota_ethercat import connect

    with connect(12001) as sensor:
        for sample in sensor:  # NoSampleError when there is none for some periods, and it says why
            print(sample.force, sample.torque)

REPEATED and INVALID frames are no samples. `latest`, `receive`, `poll` and the iteration reconnect where
necessary; they are for one thread, `ask` is for any. A client that reads more slowly than the sensor samples
has samples withheld, and GAP in `frame.flags`.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from types import TracebackType
from typing import Final

from bota_ethercat.address import Address
from bota_ethercat.client.channel import RECEIVE_BUFFER, TcpChannel
from bota_ethercat.client.reading import WARNINGS, Condition, Reading
from bota_ethercat.client.session import ClientEvent, Item, Session, check_granted
from bota_ethercat.errors import ConnectionFailedError, NoReplyError, ProtocolError, UnreachableError
from bota_ethercat.framing import DataMessage, TerminalMessage
from bota_ethercat.health.sentences import did_not_read, no_server
from bota_ethercat.pdo import ImuUnits, Sample
from bota_ethercat.program.real_time import Scheduling, make_real_time
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.terminal import decode_terminal
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import rows

ANSWER_TIMEOUT_S: Final = 5.0
_MAX_EVENTS: Final = 1000
_MAX_READS: Final = 64  # reads in one call, so that it returns whatever arrives
_BACKLOG: Final = 2048  # bytes received at once that are more than any steady stream: more may be waiting
_AGAIN_S: Final = 0.5
_STEADY_NS: Final = 50_000_000  # so old may counts be that other threads read, half of the node's tick
_CLOSED: Final = "this client has been closed"


class NoSampleError(ProtocolError):
    """No new, valid sample came in time. `condition` says why; the client goes on, and so may its caller."""

    def __init__(self, condition: Condition, text: str) -> None:
        super().__init__(text)
        self.condition = condition


def connect(
    port: int,
    host: str = "localhost",
    *,
    sensors: Sequence[int] | None = None,
    every: int = 1,
    fresh_only: bool = True,
    timeout_s: float | None = None,
    imu_units: ImuUnits = ImuUnits.G_DPS,
    terminals: Sequence[int] = (),
    rt_priority: int = 0,
    cpu: int = -1,
) -> Client:
    """A `Client` that is connected; `rt_priority` and `cpu` are the calling thread's (`make_real_time`).

    UnreachableError where there is no server, RefusedError if it does not grant the subscription.
    """
    client = Client(
        port, host, sensors=sensors, every=every, fresh_only=fresh_only, timeout_s=timeout_s,
        imu_units=imu_units, terminals=terminals,
    )  # fmt: skip
    try:
        client.scheduling = make_real_time(rt_priority, cpu)
        return client.connect()
    except BaseException:
        client.close()
        raise


class Client:
    """The stream of a server, its requests and its events.

    Attributes:
        events: `Connected`, `Disconnected` and the server's events, oldest first, the last thousand; take
            them out with `popleft`.
        terminal_frames: of terminals, valid ones, as `events`; `decode_terminal` decodes them.
        frame: the DATA message that the last sample came from: its sequence, stamps, sensor, flags.
        scheduling: what `connect` was granted of `rt_priority` and `cpu`.
        session: what is known of the server and its sensors.
        address: of the server.
    """

    def __init__(
        self,
        port: int,
        host: str = "localhost",
        *,
        sensors: Sequence[int] | None = None,
        every: int = 1,
        fresh_only: bool = True,
        raw: bool = False,
        stream: bool = True,
        reconnect: bool = True,
        timeout_s: float | None = None,
        imu_units: ImuUnits = ImuUnits.G_DPS,
        terminals: Sequence[int] = (),
        receive_buffer: int = RECEIVE_BUFFER,
        channel: TcpChannel | None = None,
    ) -> None:
        """Nothing is sent yet.

        `sensors`: by position on the bus, of those that are there; None for all. `every`: one frame in
        `every`. `fresh_only`: REPEATED frames only every 10 ms. `raw`: REPEATED and INVALID frames come, too.
        `terminals`: by number, of those that the server reads.
        `stream` False: no frames, only requests and events. `reconnect` False: ConnectionFailedError tells
        that the only connection has ended. `timeout_s`: how long `receive` waits for a sample; by default 5
        periods, at least 20 ms. `channel`: another one than TCP.
        """
        self.address = Address(host, port)
        self.events: deque[ClientEvent] = deque(maxlen=_MAX_EVENTS)
        self.frame: DataMessage | None = None
        self.scheduling = Scheduling()
        self.session = Session(
            sensors, every=every, fresh_only=fresh_only, raw=raw, stream=stream, imu_units=imu_units,
            terminals=terminals,
        )  # fmt: skip
        self.terminal_frames = self.session.terminal_frames
        self.channel = TcpChannel(host, port, receive_buffer) if channel is None else channel
        self._reconnect, self._timeout_s = reconnect, timeout_s
        self._open = False
        self._failed: ProtocolError | None = None
        self._reader: int | None = None
        self._stepping = False
        # When it looked at its connection last, until when it may wait there, and the longest time beyond.
        self._looked_ns = self._watched_ns = self._unread_ns = 0
        # Of `take_unread`: the last call; when the present wait began; the CPU time at the first call in it,
        # and the longest time between calls.
        self._taken_ns, self._since_ns, self._cpu_ns, self._apart_ns = 0, 0, 0, 0
        self._sending = threading.Lock()
        self._closing = threading.Event()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def connect(self) -> Client:
        """Wait for the connection; UnreachableError, RefusedError or ConnectionFailedError if it fails."""
        while not self.session.connected:
            self._failed = None
            self._step(_AGAIN_S)
            if self._failed is not None:
                raise self._failed
        return self

    def close(self) -> None:
        """End the connection, and do not reconnect. From any thread; waiting calls and requests fail."""
        self._closing.set()
        self.channel.shutdown()
        if not self._stepping:  # else the thread that is there closes the socket, which it may be reading
            self._end(ConnectionFailedError(_CLOSED))

    def fileno(self) -> int:
        """For `poll` or `epoll`; another one after a new connection, -1 without one."""
        return self.channel.fileno()

    @property
    def description(self) -> JsonObject:
        """The server's newest description; empty before the first connection."""
        return self.session.description

    # -- samples

    def latest(
        self, sensor: int | None = None, *, max_age_s: float = 0.01, timeout_s: float = 0.0
    ) -> Reading:
        """The newest sample of a sensor, by default the first, and whether it may be used; for control loops.

        Takes all that has arrived; with `timeout_s` waits at most that long for a sample that no reading had.
        Tells by `condition` what is wrong, and does not raise.
        """
        session = self.session
        state = session.state(session.first if sensor is None else sensor)
        deadline_ns = self.channel.monotonic_ns() + round(timeout_s * 1e9)
        left_s = 0.0
        while not self._closing.is_set():
            try:
                self._gather(left_s)
            except ConnectionFailedError:  # the only connection has ended
                self.channel.wait(self._closing, max(left_s, 0.0))
            self._pop_frames()
            left_s = (deadline_ns - self.channel.monotonic_ns()) * 1e-9
            if state.unread or left_s <= 0:
                break
        return state.read(round(max_age_s * 1e9), self.channel.monotonic_ns(), connected=session.connected)

    def receive(self, timeout_s: float | None = None) -> list[DataMessage]:
        """New, valid samples in the order of arrival, at least one; NoSampleError if none comes in time.

        `timeout_s` is by default that of the client; 0 takes those that have arrived. Of several sensors
        each must have one in it, unless it is 0.
        """
        session = self.session
        if timeout_s is None:
            timeout_s = session.timeout_s if self._timeout_s is None else self._timeout_s
        timeout_ns = round(max(timeout_s, 0.0) * 1e9)
        deadline_ns = self.channel.monotonic_ns() + timeout_ns
        left_s, frames = timeout_s, list[DataMessage]()
        self._looked_ns, self._unread_ns = self.channel.monotonic_ns(), 0  # what was before is its caller's
        while True:
            self._gather(left_s)
            frames = self._pop_frames()
            left_s = (deadline_ns - self.channel.monotonic_ns()) * 1e-9
            if frames or left_s <= 0:
                break
        silent = session.first
        if frames:
            found = session.find_silent(timeout_ns) if timeout_ns else None
            if found is None:
                return frames
            silent = found
        session.items.extendleft(reversed(frames))
        silence_ns = max(timeout_ns, round(session.timeout_s * 1e9))
        condition = session.state(silent).why_old(
            silence_ns, self.channel.monotonic_ns(), connected=session.connected
        )
        why = str(condition)
        if session.problem:
            why += f" ({self.address}: {session.problem})"
        elif condition is Condition.LATE:
            why = f"the one before came within the last {silence_ns * 1e-6:g} ms"
        if condition is Condition.SILENT and (unread_s := self._unread_ns * 1e-9) > max(timeout_s, 0):
            why = f"late: {did_not_read(unread_s)[0]}"
        raise NoSampleError(condition, f"no new sample of sensor {silent} for {timeout_s * 1e3:g} ms: {why}")

    def __iter__(self) -> Iterator[Sample]:
        """Every new and valid sample as it comes, decoded; as `receive`."""
        while True:
            for frame in self.receive():
                self.frame = frame
                yield self.decode(frame)

    def poll(self, timeout_s: float = 0.0) -> list[DataMessage]:
        """The frames that have arrived, if any, waiting at most `timeout_s` for the first, or an event."""
        self._gather(timeout_s)
        return self._pop_frames()

    def poll_all(self, timeout_s: float = 0.0) -> list[Item]:
        """As `poll`, with events, and what is in force from there on, in their places between the frames."""
        self._gather(timeout_s)
        return self.session.pop_items()

    def steady(self, sensor: int, timeout_s: float) -> Iterator[list[DataMessage]]:
        """What arrives at once, at the least cost, while it is a sensor's next samples and nothing unusual.

        Ends when anything else comes, which `poll_all` has then, or nothing for `timeout_s`, and every 50 ms:
        only then counts and readings know of these samples.
        """
        session, receive, monotonic_ns = self.session, self.channel.receive, self.channel.monotonic_ns
        state = session.state(sensor)
        begin = state.steady
        if begin is None or (single := session.single(begin)) is None:
            return
        buffer, size, prefix, unpack = single
        frame, sequence, warnings = begin, begin.sequence, begin.process_data[WARNINGS]
        looked_ns, timeout_ns = self._looked_ns, round(timeout_s * 1e9)
        until_ns = looked_ns + _STEADY_NS
        self._watched_ns = until_ns + timeout_ns
        self._reader, self._stepping = threading.get_ident(), True
        try:
            try:
                while True:
                    count = receive(buffer, timeout_s)
                    now_ns = monotonic_ns()
                    at, frames = 0, []
                    while at + size <= count and buffer.startswith(prefix, at):
                        message = tuple.__new__(DataMessage, unpack(buffer, at))
                        number, _, _, position, flags, _, data = message
                        sequence += 1
                        if number != sequence or position != sensor or flags or data[WARNINGS] != warnings:
                            break
                        frames.append(message)
                        at += size
                    if at != count or not frames or now_ns > until_ns:
                        break
                    frame, looked_ns = message, now_ns
                    yield frames
            finally:
                self._looked_ns, self._watched_ns = looked_ns, looked_ns + timeout_ns
                if frame is not begin:
                    state.add_run(frame, looked_ns, session.same_machine)
            self._received(count, now_ns)
        except ProtocolError as error:
            self._fail(error)
        finally:
            self._stepping = False

    def frames(self) -> Iterator[DataMessage]:
        """The frames as they come; without end, or with `reconnect` False until the connection ends."""
        with contextlib.suppress(ConnectionFailedError):
            while True:
                yield from self.poll(_AGAIN_S)

    def decode(self, frame: DataMessage) -> Sample:
        """The sample in `frame`."""
        return self.session.state(frame.sensor).decode(frame)

    def decode_terminal(self, frame: TerminalMessage) -> dict[str, float]:
        """The values in a terminal's frame by name, in their order; units are not known."""
        described = rows(self.description.get("terminals"))[frame.sensor : frame.sensor + 1]
        return decode_terminal(described[0] if described else {}, frame.process_data)

    def measured_ns(self, frame: DataMessage, channel: str = "force_torque") -> int | None:
        """As `Reading.measured_ns`, with the filters as of now."""
        delay_ns = getattr(self.session.timeline[frame.sensor].info.delay_ns, channel)
        return None if delay_ns is None else frame.stamp_ns - delay_ns

    # -- requests

    def ask(self, action: str, timeout_s: float = ANSWER_TIMEOUT_S, **values: object) -> JsonObject:
        """The reply that grants a request; what comes meanwhile is kept for later. From any thread.

        RefusedError if it is refused, NoReplyError if no reply comes in `timeout_s`, ConnectionFailedError if
        there is no connection or it ends.
        """
        future = self.request(action, **values)
        try:
            deadline_ns = self.channel.monotonic_ns() + round(timeout_s * 1e9)
            over = threading.Event()
            future.add_done_callback(lambda _: over.set())
            while not over.is_set():
                left_ns = deadline_ns - self.channel.monotonic_ns()
                if left_ns <= 0:
                    late_s = (self.channel.monotonic_ns() - self._watched_ns) * 1e-9
                    why = f": {did_not_read(late_s)[0]}" if late_s > timeout_s / 2 else ""
                    raise NoReplyError(f"no reply to {action} within {timeout_s:g} s{why}")
                if self._reader == threading.get_ident():
                    self._step(left_ns * 1e-9)
                else:
                    self.channel.wait(over, left_ns * 1e-9)
        finally:
            self.session.forget(future)
        reply = future.result()
        check_granted(reply)
        return reply

    def request(self, action: str, **values: object) -> Future[JsonObject]:
        """Send a request; the future gets the reply, granted or not. From any thread.

        ConnectionFailedError if there is no connection; also the future's, if it ends before the reply.
        """
        if not self.session.connected:
            raise ConnectionFailedError(f"not connected to {self.address} ({self.session.problem})")
        future, data = self.session.ask(action, **values)
        try:
            self._send(data)
        except ConnectionFailedError:
            self.session.forget(future)
            raise
        return future

    def take_unread(self) -> tuple[float, bool]:
        """The longest time since the last call in which it did not look at its connection though it should
        have, s, and whether this process did other things meanwhile, or was not run. For health's `judge`;
        to be called regularly, from any thread.
        """
        now_ns, cpu_ns = self.channel.monotonic_ns(), time.process_time_ns()
        longest_ns = max(self._unread_ns, now_ns - self._watched_ns) if self._open else 0
        # It did other things if it used the CPU, or if the thread that calls this was run all the time.
        apart_ns = now_ns - self._taken_ns
        self._apart_ns = max(self._apart_ns, apart_ns)
        busy = max(cpu_ns - self._cpu_ns, longest_ns - self._apart_ns) > longest_ns // 2
        if self._since_ns != self._looked_ns:
            self._since_ns, self._cpu_ns, self._apart_ns = self._looked_ns, cpu_ns, apart_ns
        self._taken_ns, self._unread_ns = now_ns, 0
        return longest_ns * 1e-9, busy

    # -- one step at a time

    def _gather(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` until there is something in `session.items`; take all that has arrived."""
        items, monotonic_ns = self.session.items, self.channel.monotonic_ns
        of_terminals = len(self.terminal_frames)
        left_s, begun_ns = 0.0 if items else timeout_s, monotonic_ns()
        for _ in range(_MAX_READS):
            count = self._step(left_s)
            if count < _BACKLOG and (items or left_s <= 0 or len(self.terminal_frames) != of_terminals):
                return
            left_s = 0.0 if items else timeout_s - (monotonic_ns() - begun_ns) * 1e-9

    def _pop_frames(self) -> list[DataMessage]:
        """The frames among the items; `events` gets the others."""
        frames = list[DataMessage]()
        for item in self.session.pop_items():
            if isinstance(item, DataMessage):
                frames.append(item)
            elif not isinstance(item, InForce):
                self.events.append(item)
        return frames

    def _step(self, timeout_s: float) -> int:
        """Connect if that is due, or receive once, waiting at most `timeout_s`; the bytes received.

        ConnectionFailedError where there is no connection and none is to be made.
        """
        session, channel = self.session, self.channel
        self._reader, self._stepping = threading.get_ident(), True
        try:
            if self._closing.is_set():
                raise ConnectionFailedError(_CLOSED)
            if self._open:
                self._watched_ns = self._looked_ns + round(timeout_s * 1e9)
                with session.get_buffer() as buffer:
                    count = channel.receive(buffer, timeout_s)
                self._received(count, channel.monotonic_ns())
                return count
            if self._failed and not self._reconnect:
                raise self._failed
            wait_s = (session.retry_at_ns - channel.monotonic_ns()) * 1e-9
            if wait_s > 0:
                channel.wait(self._closing, min(wait_s, timeout_s))
            elif channel.connect(min(timeout_s, _AGAIN_S)):  # which `close` does not end
                self._open = True
                self._looked_ns = self._watched_ns = channel.monotonic_ns()
                self._send(session.opened(channel.monotonic_ns(), same_address=channel.same_address))
        except ProtocolError as error:
            self._fail(error)
        finally:
            self._stepping = False
        return 0

    def _received(self, count: int, now_ns: int) -> None:
        self._unread_ns = max(self._unread_ns, now_ns - self._watched_ns)
        self._looked_ns = self._watched_ns = now_ns
        answer = self.session.received(count, now_ns)
        if answer:
            self._send(answer)

    def _fail(self, error: ProtocolError) -> None:
        """The connection has failed; raises it where no other is to be made."""
        if self._failed is error:
            raise error
        self._end(error)
        if self._closing.is_set():
            raise error

    def _end(self, error: ProtocolError) -> None:
        reachable = not isinstance(error, UnreachableError)
        self._open = False
        self._failed = error if reachable else UnreachableError(no_server(self.address, error))
        self.channel.close()
        self.session.ended(str(error), self.channel.monotonic_ns(), reachable=reachable)

    def _send(self, data: bytes) -> None:
        with self._sending:
            self.channel.send(data)
