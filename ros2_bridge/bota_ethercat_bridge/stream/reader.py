# SPDX-License-Identifier: Apache-2.0
"""The reader: the thread that the node's client receives in, which publishes at once. Nothing else touches
the stream.

With a channel and a clock of the caller's `run` needs neither sockets nor real time. `thread` runs it.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple, Protocol

from bota_ethercat.client.channel import TcpChannel
from bota_ethercat.client.client import Client
from bota_ethercat.client.session import ClientEvent, Connected, Disconnected
from bota_ethercat.control import Event
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.framing import DataMessage, TerminalMessage
from bota_ethercat.health.sentences import no_server
from bota_ethercat.pdo import LAYOUTS, Values, flags_of
from bota_ethercat.replies import MAX_DELAY_MS, Description
from bota_ethercat.stream.timeline import InForce
from bota_ethercat.text.untrusted import rows
from bota_ethercat_bridge.parameters.table import Parameters
from bota_ethercat_bridge.process import Worker
from bota_ethercat_bridge.stream.frame_selector import FrameCounts, FrameSelector
from bota_ethercat_bridge.stream.link import SYSTEM_CLOCK, Link, NodeClock, sentence

_WAIT_S: Final = 0.1  # so that silence is known to be the server's
# Times that a ROS message can carry, less the longest delay of a filter.
_FIRST_STAMP_NS: Final = MAX_DELAY_MS * 10**6
_LAST_STAMP_NS: Final = (2**31 - 1) * 10**9
_SOMETIMES: Final = {"throttle_duration_sec": 10.0}
_MOST_NOTED: Final = 8192


class Flags(NamedTuple):
    """The fields of a sample that say how the sensor is: its last ones."""

    status: int
    warnings: int
    force_torque_saturated: int
    acceleration_saturated: int
    angular_rate_saturated: int


NO_FLAGS: Final = Flags(0, 0, 0, 0, 0)
_SATURATED: Final = Flags._fields.index("force_torque_saturated")
_UNPACK: Final = {size: layout.struct.unpack for size, layout in LAYOUTS.items()}


class Output(Protocol):
    """A topic, or some that belong together, fed with every selected sample."""

    @property
    def parts(self) -> Sequence[slice]:
        """What it publishes of `Values`: all of it is finite when `publish` is called."""

    @property
    def topics(self) -> Sequence[Any]:
        """Each `publishing.messages.Topic` of it."""

    def is_wanted(self) -> bool:
        """Whether anything needs `publish`. Called now and then, not by the reader."""

    def publish(self, values: Values, frame: DataMessage, /) -> None:
        """Publish `values`, which came in `frame`: its stamp, and for intervals its monotonic time."""

    def observe(self, values: Values, frame: DataMessage) -> None:
        """Take note of a sample that `publishing_frequency` leaves out."""

    def configure(self, parameters: Parameters) -> None:
        """Take other parameters, such as covariances, from the next sample on; for the executor's thread."""


class Outputs:
    """All outputs. `wanted` are those that were so at the last `refresh`."""

    def __init__(self, outputs: Sequence[Output]) -> None:
        self.all = tuple(outputs)
        self.wanted: tuple[Output, ...] = ()

    def refresh(self) -> None:
        """Ask who has subscribed: 1 µs a topic, too much for every sample but not for now and then."""
        self.wanted = tuple(output for output in self.all if output.is_wanted())

    def publish_finite(self, values: Values, frame: DataMessage) -> None:
        """Publish a sample that is not finite everywhere where it is."""
        for output in self.wanted:
            if math.isfinite(sum(sum(values[part]) for part in output.parts)):
                output.publish(values, frame)


class Reader:
    """Feeds `outputs` from the server until `stop`. `on_failure` is called with an unexpected error.

    The monitor reads the attributes, `pop_flags` and `pop_ages`: append and popleft of a deque are atomic.

    Attributes:
        values, stamp_ns: the newest that were published, and their time since the Unix epoch.
        saturated: samples whose force or torque was saturated.
        not_finite: samples that were not published for that.
        between_samples: called once, in the reader's thread, when all topics have what they get of a sample.
    """

    between_samples: Callable[[], object] | None = None
    values: Values | None = None
    stamp_ns = saturated = not_finite = 0

    def __init__(
        self, parameters: Parameters, outputs: Outputs, log: Any, on_failure: Callable[[str], object], *,
        channel: TcpChannel | None = None, clock: NodeClock = SYSTEM_CLOCK,
    ) -> None:  # fmt: skip
        self._sensor, self._outputs, self._log = parameters.sensor, outputs, log
        self.client = Client(
            parameters.server_port, parameters.server_host, sensors=[self._sensor],
            terminals=range(parameters.terminals), channel=channel,
        )  # fmt: skip
        self._terminals = parameters.terminals
        self.on_terminal: Callable[[TerminalMessage], object] = lambda _: None  # gets their frames
        self.counts = FrameCounts()
        self.accounting = self.client.session.state(self._sensor).accounting
        self.accounting.counts = self.counts
        self._monotonic_ns = clock.monotonic_ns
        self.link = Link(self.client, self._sensor, clock)
        self._flags: tuple[object, ...] = NO_FLAGS
        self._flag_changes: deque[tuple[Any, ...]] = deque([NO_FLAGS], maxlen=_MOST_NOTED)
        # Nanoseconds from a sample to the end of its publication, newest last.
        self._ages: deque[int] = deque(maxlen=_MOST_NOTED)
        self._limit_hz = parameters.publishing_frequency
        self._selector = FrameSelector(self.counts, same_clock=True, limit_hz=self._limit_hz)
        self._problem: str | None = None
        self.thread = Worker("reader", self.run, on_failure)

    def stop(self) -> bool:
        self.client.close()
        return self.thread.has_ended()

    def limit_rate(self, hz: float) -> None:
        """Publish at most this many samples a second, 0 = all; from any thread."""
        if hz != self._limit_hz:
            self._limit_hz = hz
            self._selector.limit(hz)

    def pop_flags(self, flags: Flags) -> Flags:
        """`flags` and all that were set since the last call, if only for one sample, or are set now."""
        changes = self._flag_changes
        while True:
            flags = Flags(*(mine | theirs for mine, theirs in zip(flags, changes[0], strict=True)))
            if len(changes) == 1:
                return flags
            changes.popleft()

    def pop_ages(self) -> list[int]:
        """The ages since the last call, in ascending order."""
        taken, self._ages = self._ages, deque(maxlen=_MOST_NOTED)
        return sorted(taken)

    def run(self) -> None:
        with contextlib.suppress(ConnectionFailedError):
            while True:
                self.read(_WAIT_S)

    def read(self, timeout_s: float) -> None:
        """Publish what arrives within `timeout_s`; ConnectionFailedError once `client` has been closed."""
        if (call := self.between_samples) is not None:
            self.between_samples = None
            call()
        if not self._limit_hz:
            self._read_steady(timeout_s)
        frames: list[DataMessage] = []
        for item in self.client.poll_all(timeout_s):
            if isinstance(item, DataMessage):
                if item.sensor == self._sensor:
                    frames.append(item)
                continue
            if frames:
                self._select(frames)
                frames = []
            if not isinstance(item, InForce):
                self._handle_event(item)
            elif item.sensor == self._sensor:
                self.link.tell(item)
        if frames:
            self._select(frames)
        while self.client.terminal_frames:
            frame = self.client.terminal_frames.popleft()
            if _FIRST_STAMP_NS <= frame.stamp_ns <= _LAST_STAMP_NS:
                self.on_terminal(frame)

    def _read_steady(self, timeout_s: float) -> None:
        """Publish each sample as it comes, while nothing is unusual: the way of nearly all."""
        is_on_time, monotonic_ns = self._selector.is_on_time, self._monotonic_ns
        for frames in self.client.steady(self._sensor, timeout_s):
            if len(frames) == 1 and is_on_time(frames[0], monotonic_ns()):
                self._publish(frames[0])
            else:
                self._select(frames)

    def _select(self, frames: Sequence[DataMessage]) -> None:
        """Publish those of the frames that are to be; others that are skipped as too old are not decoded."""
        selected = self._selector.select(frames, self._monotonic_ns())
        for frame in self._selector.passed_over:
            values = self._unpacked(frame.process_data)
            if math.isfinite(sum(values)):
                for output in self._outputs.wanted:
                    output.observe(values, frame)
            else:
                self.not_finite += 1
        for frame in selected:
            self._publish(frame)

    def _publish(self, frame: DataMessage) -> None:
        """Unpack a sample once, and hand it on."""
        _, stamp_ns, monotonic_ns, _, _, _, process_data = frame
        values = self._unpacked(process_data)
        if not _FIRST_STAMP_NS <= stamp_ns <= _LAST_STAMP_NS:
            self._log.warning(
                f"a sample with the impossible time {stamp_ns} ns was not published", **_SOMETIMES
            )
        elif math.isfinite(sum(values)):  # which no infinity and no NaN survives
            for output in self._outputs.wanted:
                output.publish(values, frame)
            self.values, self.stamp_ns = values, stamp_ns
        else:
            self._outputs.publish_finite(values, frame)
            self.stamp_ns = stamp_ns
            self.not_finite += 1
            self._log.warning(
                f"a sample with numbers that are not finite was not published ({self.not_finite} so far)",
                **_SOMETIMES,
            )
        self._ages.append(self._monotonic_ns() - monotonic_ns)

    def _unpacked(self, process_data: bytes) -> Values:
        values = _UNPACK[len(process_data)](process_data)
        if (flags := flags_of(values)) != self._flags or flags[_SATURATED]:
            self._note_flags(flags)
        return values

    def _note_flags(self, flags: tuple[int, ...]) -> None:
        if flags != self._flags:
            self._flags = flags
            self._flag_changes.append(flags)
        self.saturated += flags[_SATURATED] != 0

    def _handle_event(self, event: ClientEvent) -> None:
        link = self.link
        if isinstance(event, Connected):
            self._selector = FrameSelector(
                self.counts, same_clock=self.client.session.same_machine, limit_hz=self._limit_hz
            )
            link.connected()
            again = " again" if event.again else ""
            found = Description.parse(event.description).find(self._sensor)
            self._log.info(f"connected{again} to {link.address}: {found}")
            if (read := len(rows(event.description.get("terminals")))) < self._terminals:
                self._log.warning(f"the server reads {read} of {self._terminals} terminals: name them there")
            self._problem = None
        elif isinstance(event, Disconnected):
            if event.reason.startswith("the server has no sensor"):
                event = event._replace(reason=f"{event.reason}: set the parameter 'sensor' to one it has")
            link.disconnected(event)
            self._log_problem(event)
        elif event.get("sensor", self._sensor) == self._sensor:
            text = sentence(event, link.info.settings)
            # A line of source has one severity: rclpy insists.
            if event["event"] in (Event.SENSOR_LOST, Event.EMERGENCY):
                self._log.warning(text)
            else:
                self._log.info(text)

    def _log_problem(self, event: Disconnected) -> None:
        """Log a problem once, however often it comes back."""
        if event.reachable:
            text = f"connection to {self.link.address} ended: {event.reason}; connecting again"
            known = self._problem == text
        else:
            # After a connection that ended, this only says what is known already.
            text = f"{no_server(self.link.address, event.reason)} (the node keeps trying)"
            known = self._problem is not None
        if not known:
            self._problem = text
            self._log.warning(text)
