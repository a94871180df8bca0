# SPDX-License-Identifier: Apache-2.0
"""The reader: the thread that the node's client receives in, which publishes at once. Nothing else touches
the stream.

With a channel and a clock of the caller's `run` needs neither sockets nor real time. `thread` runs it.
"""

from __future__ import annotations

import contextlib
import math
import struct
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
from bota_ethercat.pdo import LAYOUTS, Sample, SampleDecoder
from bota_ethercat.replies import MAX_DELAY_MS
from bota_ethercat.text.untrusted import rows
from bridge.parameters.table import Parameters
from bridge.process import Worker
from bridge.stream.frame_selector import FrameCounts, FrameSelector
from bridge.stream.link import SYSTEM_CLOCK, Clock, Link, sentence

_WAIT_S: Final = 0.1  # so that silence is known to be the server's
# Times that a ROS message can carry, less the longest delay of a filter.
_FIRST_STAMP_NS: Final = MAX_DELAY_MS * 10**6
_LAST_STAMP_NS: Final = (2**31 - 1) * 10**9
_SOMETIMES: Final = {"throttle_duration_sec": 10.0}
_MOST_NOTED: Final = 8192


class Flags(NamedTuple):
    """The fields of the process data that say how the sensor is."""

    status: int = 0
    warnings: int = 0
    force_torque_saturated: int = 0
    acceleration_saturated: int = 0
    angular_rate_saturated: int = 0

    def merge(self, other: tuple[int, ...]) -> Flags:
        """What is set in either."""
        return Flags(*(mine | theirs for mine, theirs in zip(self, other, strict=True)))


_BASE: Final = LAYOUTS[min(LAYOUTS)]
# Of every size of process data, which all begin alike: the flags, and nothing of the rest.
_FLAGS: Final = struct.Struct(
    "<" + "".join(f.type.value if f.name in Flags._fields else f"{f.type.size}x" for f in _BASE.fields)
)
_FORCE_TORQUE: Final = Flags._fields.index("force_torque_saturated")


class Watch:
    """What the hot path notes for the diagnostics: the sensor's flags and the samples' ages. No locks.

    `see` is for the reader, `take_flags` and `take_ages` are for the monitor: a deque's append and popleft
    are atomic.
    """

    def __init__(self) -> None:
        self._seen = self._current = tuple(Flags())
        self._changes: deque[tuple[int, ...]] = deque(maxlen=_MOST_NOTED)
        # Nanoseconds from a sample to the end of its publication, newest last.
        self.ages: deque[int] = deque(maxlen=_MOST_NOTED)
        self.sample: Sample | None = None  # the newest sample that was published
        self.stamp_ns = 0  # its time, ns since the Unix epoch
        self.saturated = 0  # samples whose force or torque was saturated

    def see(self, frames: Sequence[DataMessage]) -> None:
        """Note the flags of new frames, whether they are to be published or not."""
        for frame in frames:
            flags = _FLAGS.unpack_from(frame.process_data)
            if flags != self._seen:
                self._seen = flags
                self._changes.append(flags)
            if flags[_FORCE_TORQUE]:
                self.saturated += 1

    def take_flags(self) -> Flags:
        """All that were set since the last call, if only for one frame, and those that are set now."""
        merged = Flags(*self._current)
        while self._changes:
            self._current = self._changes.popleft()
            merged = merged.merge(self._current)
        return merged

    def take_ages(self) -> list[int]:
        """The ages since the last call, in ascending order."""
        taken, self.ages = self.ages, deque(maxlen=_MOST_NOTED)
        return sorted(taken)


class Output(Protocol):
    """A topic, or some that belong together, fed with every selected sample."""

    @property
    def fields(self) -> Sequence[str]:
        """The fields of `Sample` that it publishes: all of them are finite when `publish` is called."""

    def is_wanted(self) -> bool:
        """Whether anything needs `publish`. Called now and then, not by the reader."""

    def publish(self, sample: Sample, frame: DataMessage, /) -> None:
        """Publish `sample`, which came in `frame`: its stamp, and for intervals its monotonic time."""

    def follow(self, sample: Sample, frame: DataMessage) -> None:
        """Take note of a sample that `publishing_frequency` leaves out."""

    def configure(self, parameters: Parameters) -> None:
        """Take other parameters, such as covariances, from the next sample on; for the executor's thread."""


class Outputs:
    """All outputs. `wanted` are those that were so at the last `refresh`."""

    def __init__(self, outputs: Sequence[Output]) -> None:
        self.all = tuple(outputs)
        self.wanted: tuple[Output, ...] = ()

    def refresh(self) -> None:
        """Look who has subscribed: 1 µs a topic, too much for every sample but not for now and then."""
        self.wanted = tuple(output for output in self.all if output.is_wanted())

    def publish_finite(self, sample: Sample, frame: DataMessage) -> None:
        """Publish a sample that is not finite everywhere where it is."""
        for output in self.wanted:
            parts = [getattr(sample, field) for field in output.fields]
            if math.isfinite(sum(sum(p) if isinstance(p, tuple) else p or 0.0 for p in parts)):
                output.publish(sample, frame)


class Reader:
    """Feeds `outputs` from the server until `stop`. `on_failure` is called with an unexpected error.

    `link` and `watch` are what other threads may read.
    """

    def __init__(
        self,
        parameters: Parameters,
        outputs: Outputs,
        log: Any,
        on_failure: Callable[[str], object],
        *,
        channel: TcpChannel | None = None,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        """Tests give `channel` and `clock`."""
        self._sensor = parameters.sensor
        self._outputs = outputs
        self._log = log
        self.counts = FrameCounts()
        self.not_finite = 0
        self._decoders = {size: SampleDecoder(size, parameters.imu_units) for size in LAYOUTS}
        self.client = Client(
            parameters.server_port, parameters.server_host, sensors=[self._sensor],
            terminals=range(parameters.terminals), channel=channel,
        )  # fmt: skip
        self._terminals = parameters.terminals
        self.on_terminal: Callable[[TerminalMessage], object] = lambda _: None  # gets their frames
        self.accounting = self.client.session.state(self._sensor).accounting
        self.accounting.counts = self.counts
        self._clock = clock
        self.link = Link(self.client, self._sensor, clock)
        self.watch = Watch()
        self._limit_hz = parameters.publishing_frequency
        self._selector = FrameSelector(self.counts, same_clock=True, limit_hz=self._limit_hz)
        self._problem: str | None = None
        self.thread = Worker("reader", self.run, on_failure)

    def stop(self) -> bool:
        """Stop reading and wait for the thread; False if it does not end in time."""
        self.client.close()
        return self.thread.has_ended()

    def limit_rate(self, hz: float) -> None:
        """Publish at most this many samples a second, 0 = all; from any thread."""
        if hz != self._limit_hz:
            self._limit_hz = hz
            self._selector.limit(hz)

    def run(self) -> None:
        """Connect and read, again and again, until `stop`."""
        with contextlib.suppress(ConnectionFailedError):
            while True:
                self.read(_WAIT_S)

    def read(self, timeout_s: float) -> None:
        """Publish what arrives within `timeout_s`; ConnectionFailedError once `client` has been closed."""
        items = self.client.poll_all(timeout_s)
        frames = []
        for item in items:
            if isinstance(item, DataMessage):
                if item.sensor == self._sensor:
                    frames.append(item)
                continue
            self._publish(frames)
            frames = []
            self._take_event(item)
        self._publish(frames)
        while self.client.terminal_frames:
            frame = self.client.terminal_frames.popleft()
            if _FIRST_STAMP_NS <= frame.stamp_ns <= _LAST_STAMP_NS:
                self.on_terminal(frame)

    def _publish(self, frames: Sequence[DataMessage]) -> None:
        if not frames:
            return
        watch, monotonic_ns = self.watch, self._clock.monotonic_ns
        watch.see(frames)
        selected = self._selector.select(frames, monotonic_ns())
        for frame in self._selector.passed_over:
            self._follow(frame)
        for frame in selected:
            sample = self._decoders[len(frame.process_data)].decode(frame.process_data)
            if not _FIRST_STAMP_NS <= frame.stamp_ns <= _LAST_STAMP_NS:
                self._log.warning(
                    f"a sample with the impossible time {frame.stamp_ns} ns was not published", **_SOMETIMES
                )
            elif sample.is_finite:
                for output in self._outputs.wanted:
                    output.publish(sample, frame)
                watch.sample, watch.stamp_ns = sample, frame.stamp_ns
            else:
                self._outputs.publish_finite(sample, frame)
                self.not_finite += 1
                self._log.warning(
                    f"a sample with numbers that are not finite was not published ({self.not_finite} so far)",
                    **_SOMETIMES,
                )
            watch.ages.append(monotonic_ns() - frame.monotonic_ns)

    def _follow(self, frame: DataMessage) -> None:
        """A sample that the limit to the rate leaves out: some outputs go by all of them."""
        sample = self._decoders[len(frame.process_data)].decode(frame.process_data)
        if sample.is_finite:
            for output in self._outputs.wanted:
                output.follow(sample, frame)
        else:
            self.not_finite += 1

    def _take_event(self, event: ClientEvent) -> None:
        link = self.link
        if isinstance(event, Connected):
            self._selector = FrameSelector(
                self.counts, same_clock=self.client.session.same_machine, limit_hz=self._limit_hz
            )
            link.connected(event.description)
            again = " again" if event.again else ""
            self._log.info(f"connected{again} to {link.address}: {link.info}")
            if (read := len(rows(event.description.get("terminals")))) < self._terminals:
                self._log.warning(f"the server reads {read} of {self._terminals} terminals: name them there")
            self._problem = None
        elif isinstance(event, Disconnected):
            if event.reason.startswith("the server has no sensor"):
                event = event._replace(reason=f"{event.reason}: set the parameter 'sensor' to one it has")
            link.disconnected(event)
            self._log_problem(event)
        else:
            before = link.info.settings
            if not link.take_event(event):
                return
            text = sentence(event, before)
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
