"""The reader: connects, receives, publishes, reconnects. Nothing else touches the stream.

`read` is the hot path: one blocking read, every whole message there is, and straight to the outputs. Clock
and connection can be given: `run` then needs neither sockets nor real time. `start` runs it in a thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from bridge.clock import SYSTEM_CLOCK, Clock
from bridge.parameters.table import Parameters
from bridge.stream.connection import Connection
from bridge.stream.events import sentence
from bridge.stream.frame_selector import FrameCounts, FrameSelector
from bridge.stream.link import Link
from bridge.stream.watch import Watch
from protocol.address import Address
from protocol.client.connection import SILENCE_S
from protocol.control import Event
from protocol.errors import ConnectionFailedError, UnreachableError
from protocol.framing import DataMessage
from protocol.pdo import LAYOUTS, Sample, SampleDecoder
from protocol.text.json_text import JsonObject
from protocol.text.visible import printable

_FIRST_DELAY_S: Final = 0.1
_LONGEST_DELAY_S: Final = 1.0
_STEADY_S: Final = 1.0
"""After a connection that lasted this long the next attempt may come at once."""
_LAST_STAMP_NS: Final = (2**31 - 1) * 10**9
"""The latest time that a ROS message can carry."""
_MAX_READS: Final = 256
"""Buffers that are drained at most before selecting from what there is."""
_WARN_EVERY_S: Final = 10.0


class Log(Protocol):
    """The part of a ROS logger that is used here."""

    def info(self, message: str) -> Any:
        """Log what happened."""

    def warning(self, message: str) -> Any:
        """Log what is not as it should be."""


class Outputs(Protocol):
    """What the samples go to: `bridge.publishing.messages.Outputs`."""

    @property
    def wanted(self) -> Sequence[Any]:
        """Those outputs that somebody has subscribed to."""

    def publish_finite(self, sample: Sample, frame: DataMessage) -> None:
        """Publish a sample that is not finite everywhere where it is."""


class Reader:
    """Feeds `outputs` from the server until `stop`. `on_failure` is called with an unexpected error.

    `link` and `watch` are what other threads may read.
    """

    def __init__(
        self,
        parameters: Parameters,
        outputs: Outputs,
        log: Log,
        on_failure: Callable[[str], object],
        *,
        connect: Callable[[str, int], Connection] = Connection,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        """Tests give `connect` and `clock`."""
        self._parameters = parameters
        self._outputs = outputs
        self._log = log
        self._on_failure = on_failure
        self.counts = FrameCounts()
        self.not_finite = 0
        self._decoders = {size: SampleDecoder(size, parameters.imu_units) for size in LAYOUTS}
        self._address = str(Address(printable(parameters.server_host), parameters.server_port))
        self._connect, self._clock = connect, clock
        self.link = Link(self._address, parameters.sensor, clock)
        self.watch = Watch(parameters.sensor)
        self._stopping = threading.Event()
        self._limit_hz = parameters.publishing_frequency
        self._selector: FrameSelector | None = None
        self._connection: Connection | None = None
        self._problem: str | None = None
        self._was_connected = False
        self._next_warning_s = 0.0
        self._thread = threading.Thread(target=self._run, name="reader", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Stop reading and wait for the thread; False if it does not end in time."""
        self._stopping.set()
        connection = self._connection
        if connection is not None:
            connection.shutdown()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def limit_rate(self, hz: float) -> None:
        """Publish at most this many samples a second, 0 = all; from any thread."""
        if hz != self._limit_hz:
            self._limit_hz = hz
            if self._selector is not None:
                self._selector.limit(hz)
            self._warn_of_aliases()

    @property
    def newest_ns(self) -> int:
        """CLOCK_MONOTONIC of the server when the newest sample was taken; -1 before the first."""
        return -1 if self._selector is None else self._selector.accounting.new_ns

    def _warn_of_aliases(self) -> None:
        if 0 < self._limit_hz < self.link.rate_hz:
            self._log.warning(
                f"publishing_frequency {self._limit_hz:g} takes the newest of {self.link.rate_hz:g} samples "
                f"a second, without a low-pass: noise and vibration above {self._limit_hz / 2:g} Hz appear "
                "at lower frequencies (aliasing); take every sample, or a longer sinc_length"
            )

    def _run(self) -> None:
        try:
            self.run()
        except Exception as error:  # noqa: BLE001 - a thread that dies silently would leave a dead node
            if not self._stopping.is_set():
                self._on_failure(f"the reader failed: {type(error).__name__}: {error}")

    def run(self) -> None:
        """Connect and read, again and again, until `stop`."""
        delay_s = _FIRST_DELAY_S
        while not self._stopping.is_set():
            began_s = self._clock.monotonic()
            try:
                self._session()
            except ConnectionFailedError as error:
                self.link.disconnected(str(error), is_reachable=not isinstance(error, UnreachableError))
                if self._stopping.is_set():
                    return
                if self._clock.monotonic() - began_s > _STEADY_S and not isinstance(error, UnreachableError):
                    delay_s = _FIRST_DELAY_S
                self._log_problem(error)
            self._clock.wait(self._stopping, delay_s)
            delay_s = min(delay_s * 1.5, _LONGEST_DELAY_S)

    def _session(self) -> None:
        """One connection from beginning to end; ConnectionFailedError is how it ends."""
        connection = self._connect(self._parameters.server_host, self._parameters.server_port)
        self._connection = connection
        try:
            if self._stopping.is_set():
                return
            info = connection.subscribe(self._parameters.sensor)
            again = " again" if self._was_connected else ""
            self._log.info(f"connected{again} to {self._address}: {info}")
            self._was_connected = True
            self._problem = None
            self.link.connected(connection, info)
            self._warn_of_aliases()
            self.read(connection)
        finally:
            self._connection = None
            connection.close()

    def read(self, connection: Connection) -> None:
        """Publish what a subscribed connection brings; ConnectionFailedError is how it ends."""
        selector = self._selector = FrameSelector(
            self._parameters.sensor, self.counts, same_clock=connection.same_machine, limit_hz=self._limit_hz
        )
        decoders, outputs, watch, link = self._decoders, self._outputs, self.watch, self.link
        monotonic_ns = self._clock.monotonic_ns
        frames: list[DataMessage] = []
        silent = False
        self._take(connection, frames)  # what followed the reply
        while not self._stopping.is_set():
            more = connection.receive()
            if more is None:
                silent = silent or self._log_silence()
                continue
            self._take(connection, frames)
            reads = 1
            while more and reads < _MAX_READS:
                more = connection.receive(wait=False)
                self._take(connection, frames)
                reads += 1
            silent = silent and (not frames or self._log_resumed())
            watch.see(frames)
            selector.accounting.rate_hz = link.rate_hz
            selected = selector.select(frames, monotonic_ns())
            for frame in selector.passed_over:
                self._follow(frame)
            for frame in selected:
                sample = decoders[len(frame.process_data)].decode(frame.process_data)
                if sample.is_finite:
                    for output in outputs.wanted:
                        output.publish(sample, frame)
                    watch.sample, watch.stamp_ns = sample, frame.stamp_ns
                else:
                    self._publish_finite(sample, frame)
                watch.ages.append(monotonic_ns() - frame.monotonic_ns)
            frames.clear()

    def _log_silence(self) -> bool:
        self._log.warning(f"nothing came from {self._address} for {SILENCE_S:g} s")
        return True

    def _log_resumed(self) -> bool:
        self._log.info(f"{self._address} sends again")
        return False

    def _take(self, connection: Connection, frames: list[DataMessage]) -> None:
        """Move every whole message that has been received to `frames`; answer the others."""
        known = len(frames)
        while (message := connection.take_data(frames)) is not None:
            if not connection.take_reply(message):
                self._log_event(message)
        for frame in frames[known:]:
            if frame.stamp_ns > _LAST_STAMP_NS:
                raise ConnectionFailedError(f"a frame has the impossible time {frame.stamp_ns} ns")

    def _follow(self, frame: DataMessage) -> None:
        """A sample that the limit to the rate leaves out: some outputs go by all of them."""
        sample = self._decoders[len(frame.process_data)].decode(frame.process_data)
        if sample.is_finite:
            for output in self._outputs.wanted:
                output.follow(sample, frame)
        else:
            self.not_finite += 1

    def _publish_finite(self, sample: Sample, frame: DataMessage) -> None:
        self._outputs.publish_finite(sample, frame)
        self.not_finite += 1
        now_s = self._clock.monotonic()
        if now_s >= self._next_warning_s:
            self._next_warning_s = now_s + _WARN_EVERY_S
            self._log.warning(
                f"a sample with numbers that are not finite was not published ({self.not_finite} so far)"
            )

    def _log_event(self, message: JsonObject) -> None:
        before = self.link.settings
        if "event" not in message or not self.link.take_event(message):
            return
        text = sentence(message, before)
        # A line of source has one severity: rclpy insists.
        if message["event"] in (Event.SENSOR_LOST, Event.EMERGENCY):
            self._log.warning(text)
        else:
            self._log.info(text)

    def _log_problem(self, error: ConnectionFailedError) -> None:
        """Log a problem once, however often it comes back."""
        if isinstance(error, UnreachableError):
            # After a connection that ended, this only says what is known already.
            text = f"no server at {self._address}: {error}; trying until there is one"
            known = self._problem is not None
        else:
            text = f"connection to {self._address} ended: {error}; connecting again"
            known = self._problem == text
        if not known:
            self._problem = text
            self._log.warning(text)
