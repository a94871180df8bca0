"""`wrench_compensated`, what was subtracted, and the same filtered and in other frames: a topic each.

The reader calls `publish` for every selected sample, but only while somebody has subscribed or a window is
open. What it goes by is a `Plan`, which the executor's thread replaces as a whole: there are no locks. TF is
listened to only while somebody has subscribed to a topic that needs it; the reader takes what was found last.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from bota_ethercat.cdr import StampedNumbers
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample, Vector3
from bridge.compensating.sources import LookUp, Source, UnusableError, check_tf, follow_tf, why_off
from bridge.parameters.table import Parameters, WrenchFrame
from bridge.publishing.messages import Stamps, Topic
from ft_compensation.bias import BiasRamp
from ft_compensation.compensator import Compensator, Stages
from ft_compensation.outputs import WrenchFilter, WrenchTransform
from ft_compensation.payload_watch import PayloadWatch
from ft_compensation.quantities import ZERO, CompensationError
from ft_compensation.stationary import StationaryWindow, triple
from ft_compensation.stationary_limits import StationaryLimits

# Failed lookups after the first subscription before it is a problem: TF has to arrive first.
_PATIENCE: Final = 200
_NS_PER_S: Final = 1_000_000_000
_SATURATED: Final = "force or torque was saturated, and on_saturation is stop"


class WrenchTopic(Topic):
    """`geometry_msgs/WrenchStamped` of one stage of the compensation."""

    problem = ""  # why nothing is published, a sentence

    def __init__(self, node: Node, topic: str, frame_id: str, stamps: Stamps, stage: str = "final") -> None:
        super().__init__(node, WrenchStamped, topic)
        self._pack, self._stamps = StampedNumbers(frame_id, 6).pack, stamps
        self.index = Stages._fields.index(stage)

    def configure(self, parameters: Parameters) -> None:
        """Take other parameters from the next sample on; for the executor's thread."""

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish a force, N, and a torque, Nm."""
        self._send(self._pack(frame.stamp_ns - self._stamps.wrench_ns, *force, *torque))


class FrameTopic(WrenchTopic):
    """`wrench_compensated/NAME`: in a frame fixed to the sensor's, or known to TF.

    `look` is for one thread, `send` the reader's.
    """

    def __init__(self, node: Node, frame: WrenchFrame, stamps: Stamps, parameters: Parameters) -> None:
        super().__init__(node, f"wrench_compensated/{frame.name}", frame.name, stamps)
        self._name, self._source = frame.name, parameters.frame_id
        self.wanted = False  # whether anybody had subscribed at the last look
        self.on_change: Callable[[], object] = lambda: None  # called when that changes
        # The transform, and of which time it is, ns; 0: it holds at any time.
        self._found: tuple[WrenchTransform, int] | None = frame.fixed and (frame.fixed, 0)
        self._error, self._misses, self._asked_ns = "", 0, 0
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        """Take the limit of the age."""
        self._limit_ns = parameters.orientation_stale_after * _NS_PER_S

    def is_wanted(self) -> bool:
        """Whether anybody has subscribed."""
        was, self.wanted = self.wanted, super().is_wanted()
        if self.wanted is not was:
            self.on_change()
        return self.wanted

    def look(self, look_up: LookUp) -> None:
        """Ask TF for the latest it has."""
        try:
            translation, rotation, stamp_ns = look_up(self._name, self._source)
        except UnusableError as error:
            self._error = str(error)
            self._misses += 1
        else:
            self._found = WrenchTransform.of(translation, rotation), stamp_ns

    def forget(self) -> None:
        """Forget the pose."""
        self._found, self._misses = None, 0

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish them in this frame, if its pose is known."""
        self._asked_ns = asked_ns = frame.stamp_ns
        if (found := self._found) is not None:
            transform, stamp_ns = found
            if not stamp_ns or abs(asked_ns - stamp_ns) <= self._limit_ns:
                super().send(*transform.apply(force, torque), frame)

    @property
    def problem(self) -> str:  # type: ignore[override]
        """Why nothing is published, a sentence."""
        what = f"wrench_compensated/{self._name} has stopped: "
        if self._found is None:
            return "" if self._misses < _PATIENCE else what + self._error
        behind_ns = self._asked_ns - self._found[1] if self._found[1] and self._asked_ns else 0
        off = why_off(behind_ns / _NS_PER_S, self._limit_ns / _NS_PER_S)
        return off and f"{what}TF's latest pose of {self._source} in {self._name} {off}"


def make_frames(node: Node, parameters: Parameters, stamps: Stamps) -> list[FrameTopic]:
    """A topic for each of the parameter `wrench_frames`; ParameterError if one needs TF and there is none."""
    frames = {frame: FrameTopic(node, frame, stamps, parameters) for frame in parameters.wrench_frames}
    by_tf = [frame.name for frame in frames if frame.fixed is None]
    if by_tf:
        check_tf(f"parameter wrench_frames has {by_tf[0]!r} by TF", f"give its pose: '{by_tf[0]} x y z'")
        _follow_tf(node, [topic for frame, topic in frames.items() if frame.fixed is None])
    return list(frames.values())


def _follow_tf(node: Node, topics: Sequence[FrameTopic]) -> None:
    """Listen to TF while one of `topics` is wanted."""
    group, close = MutuallyExclusiveCallbackGroup(), list[Callable[[], None]]()

    def look(look_up: LookUp) -> None:
        for topic in topics:
            if topic.wanted:
                topic.look(look_up)

    def change() -> None:
        wanted = any(topic.wanted for topic in topics)
        if wanted and not close:
            close.append(follow_tf(node, group, look))
        elif close and not wanted:
            close.pop()()
            for topic in topics:
                topic.forget()

    guard = node.create_guard_condition(change, group)
    for topic in topics:
        topic.on_change = guard.trigger


class FilteredTopic:
    """`wrench_filtered`, if configured, from every sample: `publishing_frequency` comes after it."""

    index = Stages._fields.index("final")

    def __init__(
        self, node: Node, parameters: Parameters, stamps: Stamps, rate_hz: Callable[[], float]
    ) -> None:
        """`rate_hz` tells the sensor's sampling rate, 0 if it is not known."""
        self._node, self._frame_id, self._stamps = node, parameters.frame_id, stamps
        self._rate_hz = rate_hz
        self.problem = ""
        self._topic: WrenchTopic | None = None
        self._filter = WrenchFilter()
        self._designed: tuple[float, float] | None = None
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        """Take other settings from the next sample on; for the executor's thread."""
        self._cutoff_hz = parameters.filter_cutoff
        if self._cutoff_hz and self._topic is None:
            self._topic = WrenchTopic(self._node, "wrench_filtered", self._frame_id, self._stamps)

    def is_wanted(self) -> bool:
        """Whether it is configured and anybody has subscribed."""
        if self._topic is None or not self._cutoff_hz:
            return False
        wanted = self._topic.is_wanted()
        if not wanted and self._rate_hz():
            self._is_ready()  # so that the delay is logged before there is a subscriber
        return wanted

    def _is_ready(self) -> bool:
        """Whether there is a filter for the current settings and sampling rate."""
        cutoff_hz, rate_hz = wanted = self._cutoff_hz, self._rate_hz()
        if wanted != self._designed:
            self._designed = wanted
            try:
                self._design(cutoff_hz, rate_hz)
                self.problem = ""
            except CompensationError as error:
                self.problem = f"wrench_filtered has stopped: {error}"
                self._node.get_logger().warning(self.problem)
        return not self.problem

    def _design(self, cutoff_hz: float, rate_hz: float) -> None:
        if not cutoff_hz or not rate_hz:
            why = "the server does not report the sampling rate" if cutoff_hz else "filter.cutoff is 0"
            raise CompensationError(why)
        self._filter.design(cutoff_hz, rate_hz)
        self._node.get_logger().info(
            f"wrench_filtered is delayed by {self._filter.delay_s * 1e3:.1f} ms: cut-off "
            f"{cutoff_hz:g} Hz, sampling rate {rate_hz:g} Hz"
        )

    def note(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Filter a sample that is not published."""
        if self._is_ready():
            self._filter.step(force, torque, frame.monotonic_ns)

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Filter a sample and publish it."""
        if self._is_ready() and self._topic is not None:
            self._topic.send(*self._filter.step(force, torque, frame.monotonic_ns), frame)


class Plan(NamedTuple):
    """What is done with a sample."""

    source: Source
    compensator: Compensator
    ramp: BiasRamp
    has_tool: bool  # whether anything has weight
    # Checks now and then whether the payload is still the one that is compensated.
    watch: PayloadWatch | None = None


class RestWindow(StationaryWindow):
    """Samples of some time at rest, and the specific force meanwhile."""

    def __init__(self, seconds: float, limits: StationaryLimits, source: Source) -> None:
        super().__init__(seconds, limits)
        self.source = source
        self.done = threading.Event()
        self._taken, self._unknown = list[Vector3](), ""

    def take(self, sample: Sample, time_s: float, stamp_s: float, specific_force: Vector3 | None) -> bool:
        """Take a sample and its specific force, for the reader. True: the window is complete."""
        if specific_force is None:
            self._unknown = self._unknown or self.source.why_none(sample, stamp_s) or "not in every sample"
        else:
            self._taken.append(specific_force)
        if self.add(sample, time_s):
            self.done.set()
        return self.done.is_set()

    def specific_force(self) -> Vector3:
        """Its mean in the sensor's frame, m/s²; CompensationError if it was not known all the time."""
        if self._unknown or not self._taken:
            raise CompensationError(
                f"the weight of the tool is not known: {self._unknown or 'no sample came'}"
            )
        return triple(np.mean(self._taken, axis=0))


class CompensatedOutput:
    """All topics of the compensation, as one output of the reader's."""

    fields = ("force", "torque")

    def __init__(
        self, node: Node, parameters: Parameters, stamps: Stamps, rate_hz: Callable[[], float]
    ) -> None:
        """ParameterError if a frame cannot be had. `rate_hz` as for `FilteredTopic`."""
        stages = {"wrench_compensated": "final", "compensation/bias": "bias", "compensation/tool": "tool"}
        self._filtered = FilteredTopic(node, parameters, stamps, rate_hz)
        final, *subtracted = (
            WrenchTopic(node, topic, parameters.frame_id, stamps, stage) for topic, stage in stages.items()
        )
        frames = make_frames(node, parameters, stamps)
        self._all: tuple[WrenchTopic | FilteredTopic, ...] = (final, *frames, self._filtered, *subtracted)
        self._wanted: tuple[WrenchTopic | FilteredTopic, ...] = ()
        self.has_subscribers = False  # as of the last look
        self.plan = Plan(Source(), Compensator(), BiasRamp(), has_tool=False)
        self.window: RestWindow | None = None  # the one that is open
        self.hold = ""  # why nothing may be published for now, whatever else is known
        self.stops_on_saturation = False  # whether saturated samples are not published
        # Samples since the node started that were compensated, and that were not.
        self.published = self.withheld = 0
        self.why_withheld = ""  # the latest of them; empty: the source knew nothing
        self.is_stopped = False  # whether the latest could not be compensated
        self.sample: Sample | None = None  # the latest that came here
        # Its time, s: by the server's monotonic clock, and since the Unix epoch.
        self.time_s = self.stamp_s = 0.0
        self.configure(parameters)

    def is_wanted(self) -> bool:
        """Whether anybody has subscribed to any of the topics, or a window is open."""
        self._wanted = tuple(topic for topic in self._all if topic.is_wanted())
        self.has_subscribers = bool(self._wanted)
        if not self._wanted:
            self.is_stopped = False
        return self.has_subscribers or self.window is not None

    @property
    def problem(self) -> str:
        """Why single subscribed topics are silent; "" if none is."""
        return "; ".join(topic.problem for topic in self._wanted if topic.problem)

    def configure(self, parameters: Parameters) -> None:
        """Take what parameters say of the topics; for the executor's thread."""
        self.stops_on_saturation = parameters.on_saturation == "stop"
        for topic in self._all:
            topic.configure(parameters)

    def follow(self, sample: Sample, frame: DataMessage) -> None:
        """Give source, open window and filter a sample that is not published."""
        plan = self.plan
        specific_force = self._specific_force(plan, sample, frame)
        if self._filtered in self._wanted and specific_force is not None and not self.hold:
            self._filtered.note(*self._stages(plan, sample, specific_force, self.time_s).final, frame)

    def _specific_force(self, plan: Plan, sample: Sample, frame: DataMessage) -> Vector3 | None:
        """The specific force as far as it is needed, None if it is not known; the window takes the sample."""
        self.sample, time_s, stamp_s = sample, frame.monotonic_ns * 1e-9, frame.stamp_ns * 1e-9
        self.time_s, self.stamp_s = time_s, stamp_s
        window = self.window
        if not plan.has_tool and window is None:
            return ZERO
        specific_force = plan.source.specific_force(sample, time_s, stamp_s)
        if window is not None and window.take(sample, time_s, stamp_s, specific_force):
            self.window = None
        return specific_force if plan.has_tool else ZERO

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Compensate a sample and publish its stages; nothing if the tool's weight is not known."""
        plan = self.plan
        specific_force = self._specific_force(plan, sample, frame)
        time_s = self.time_s
        is_saturated = self.stops_on_saturation and sample.force_torque_saturated != 0
        if specific_force is None or self.hold or is_saturated:
            self.is_stopped = True
            self.withheld += 1
            self.why_withheld = self.hold or (_SATURATED if is_saturated else "")
            return
        self.is_stopped = False
        stages = self._stages(plan, sample, specific_force, time_s)
        for topic in self._wanted:
            topic.send(*stages[topic.index], frame)
        self.published += 1
        if (watch := plan.watch) is not None and watch.is_due(time_s):
            gravity = -specific_force[0], -specific_force[1], -specific_force[2]
            watch.look(stages.final.force, gravity, sample.angular_rate, time_s)

    @staticmethod
    def _stages(plan: Plan, sample: Sample, specific_force: Vector3, time_s: float) -> Stages:
        compensator = plan.compensator
        compensator.bias = plan.ramp.at(time_s)
        return compensator.compensate(sample.force, sample.torque, specific_force, plan.source.turning)
