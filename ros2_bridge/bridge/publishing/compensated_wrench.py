# SPDX-License-Identifier: Apache-2.0
"""`wrench_compensated`, what was subtracted, and the same filtered and in other frames: a topic each.

The reader calls `publish` for every selected sample, but only while somebody has subscribed or a window is
open. What it goes by is a `Plan`, which the executor's thread replaces as a whole: there are no locks. Frames
known to TF have a thread of their own, which waits for the pose at the sample's stamp.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from std_msgs.msg import Header

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample, Vector3
from bridge.compensating.sources import Pose, Source, Tf, UnusableError, check_tf, why_off
from bridge.parameters.table import Parameters
from bridge.process import Worker
from bridge.publishing.messages import Stamps, Topic
from bridge.rclpy_internals import packer
from bridge.stream.link import Clock
from ft_compensation.bias import BiasRamp
from ft_compensation.compensator import Compensator, Stages
from ft_compensation.outputs import WrenchFilter, WrenchTransform
from ft_compensation.quantities import ZERO, CompensationError, StationaryLimits
from ft_compensation.stationary import StationaryWindow, triple

_PATIENCE_S: Final = 1.0  # without a pose before it is a problem: TF has to arrive first
_LOOK_S: Final = 0.001  # how often it is looked whether the pose has come
_IDLE_S: Final = 1.0
_MOST_WAITING: Final = 2000  # samples
_NS_PER_S: Final = 1_000_000_000
_SATURATED: Final = "force or torque was saturated, and on_saturation is stop"


class WrenchTopic(Topic):
    """`geometry_msgs/WrenchStamped` of one stage of the compensation."""

    problem = ""  # why nothing is published, a sentence

    def __init__(self, node: Node, topic: str, frame_id: str, stamps: Stamps, stage: str = "final") -> None:
        super().__init__(node, WrenchStamped, topic)
        self._pack, self._stamps = packer(WrenchStamped(header=Header(frame_id=frame_id)), 6), stamps
        self.index = Stages._fields.index(stage)

    def configure(self, parameters: Parameters) -> None:
        """Take other parameters from the next sample on; for the executor's thread."""

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish a force, N, and a torque, Nm."""
        self._send(self._pack(frame.stamp_ns - self._stamps.wrench_ns, *force, *torque))


class FixedFrameTopic(WrenchTopic):
    """`wrench_compensated/NAME`: in a frame fixed to the sensor's."""

    def __init__(self, node: Node, name: str, transform: WrenchTransform, stamps: Stamps) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, stamps)
        self._transform = transform

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish them in this frame."""
        super().send(*self._transform.apply(force, torque), frame)


class TfFrameTopic(WrenchTopic):
    """`wrench_compensated/NAME`: in a frame known to TF, by the pose at the sample's stamp.

    `send` is the reader's, and waits for nothing; `look` and `forget` are for one other thread.
    """

    is_known = False  # whether TF has had its pose: until then it is looked for without a subscriber too

    def __init__(self, node: Node, name: str, stamps: Stamps, parameters: Parameters, clock: Clock) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, stamps)
        self._name, self._source, self._clock = name, parameters.frame_id, clock
        self.on_sample: Callable[[], object] = lambda: None  # called when `look` has something to do
        # Samples, and until when (s, by the clock) they wait for their poses.
        self._waiting: deque[tuple[float, Vector3, Vector3, DataMessage]] = deque()
        self.configure(parameters)
        self.forget()

    def configure(self, parameters: Parameters) -> None:
        """Take the limit of the age, and the longest wait."""
        self._limit_s, self._wait_s = parameters.orientation_stale_after, parameters.tf_wait

    def forget(self) -> None:
        """Forget what was, and what waits."""
        self._waiting.clear()
        # Stamps of the newest pose used and of the newest sample that was looked up for.
        self._found_ns = self._asked_ns = 0
        self._error, self._failing_s = "", 0.0  # why there is no pose, and since when; 0: there is
        # The largest age of a pose in about a second of samples, and up to which stamp that counts, ns.
        self.age_s: float | None = None
        self._age_until_ns = 0

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Have them published as soon as the pose at this stamp is there, or the wait is over."""
        if len(self._waiting) < _MOST_WAITING:
            self._waiting.append((self._clock.monotonic() + self._wait_s, force, torque, frame))
        self.on_sample()

    def look(self, tf: Tf) -> bool:
        """Publish what can be. True: a sample waits for its pose."""
        while self._waiting:
            due_s, force, torque, frame = self._waiting[0]
            asked_ns, now_s = frame.stamp_ns, self._clock.monotonic()
            pose = self._look_up(tf, asked_ns)
            if pose is None and now_s < due_s:
                return True
            pose = pose or self._look_up_latest(tf)
            self._waiting.popleft()
            self._asked_ns = asked_ns
            if pose is None:
                continue
            self._found_ns, self._failing_s = pose.stamp_ns or asked_ns, 0.0
            age_s = abs(asked_ns - self._found_ns) / _NS_PER_S
            if age_s >= (self.age_s or 0.0) or asked_ns > self._age_until_ns:
                self.age_s, self._age_until_ns = age_s, asked_ns + _NS_PER_S
            if age_s <= self._limit_s:
                transform = WrenchTransform.of(pose.translation, pose.rotation)
                super().send(*transform.apply(force, torque), frame)
        if not self.is_known:
            self._look_up_latest(tf)
        return False

    def _look_up_latest(self, tf: Tf) -> Pose | None:
        if (pose := self._look_up(tf, 0)) is None:
            self._failing_s = self._failing_s or self._clock.monotonic()
        return pose

    def _look_up(self, tf: Tf, at_ns: int) -> Pose | None:
        try:
            pose = tf.look_up(self._name, self._source, at_ns)
        except UnusableError as error:
            self._error = str(error)
            return None
        self.is_known = True
        return pose

    @property
    def problem(self) -> str:  # type: ignore[override]
        """Why nothing is published, a sentence."""
        what = f"wrench_compensated/{self._name} has stopped: "
        if not self._found_ns:
            is_new = not self._failing_s or self._clock.monotonic() - self._failing_s < _PATIENCE_S
            return "" if is_new else what + self._error
        off = why_off((self._asked_ns - self._found_ns) / _NS_PER_S, self._limit_s)
        return off and f"{what}TF's latest pose of {self._source} in {self._name} {off}"


def make_frames(node: Node, parameters: Parameters, stamps: Stamps, clock: Clock) -> list[WrenchTopic]:
    """A topic for each of the parameter `wrench_frames`; ParameterError if one needs TF and there is none."""
    topics: list[WrenchTopic] = []
    for name, fixed in parameters.wrench_frames:
        if fixed is not None:
            topics.append(FixedFrameTopic(node, name, fixed, stamps))
        else:
            check_tf(f"parameter wrench_frames has {name!r} by TF", f"give its pose: '{name} x y z'")
            topics.append(TfFrameTopic(node, name, stamps, parameters, clock))
    return topics


class TfFrames:
    """Its `thread` publishes the topics of frames known to TF; that is listened to while one is wanted."""

    def __init__(
        self, node: Node, topics: Sequence[WrenchTopic], clock: Clock, on_failure: Callable[[str], object]
    ) -> None:
        """`on_failure` is called with an unexpected error."""
        self._node, self._clock = node, clock
        self._topics = [topic for topic in topics if isinstance(topic, TfFrameTopic)]
        self._is_wanted = False
        self._tf: Tf | None = None
        self._stopping, self._arrived = threading.Event(), threading.Event()
        self.thread = Worker("frames", self._run, on_failure)
        self._guard = node.create_guard_condition(self._listen, MutuallyExclusiveCallbackGroup())
        for topic in self._topics:
            topic.on_sample = self._arrived.set

    @property
    def age_s(self) -> float | None:
        """The largest age of a pose in about the last second, s; None while there is none."""
        return max((topic.age_s for topic in self._topics if topic.age_s is not None), default=None)

    def want(self, topics: Sequence[object]) -> None:
        """These are wanted, among others."""
        wanted = any(topic in topics or not topic.is_known for topic in self._topics)
        was, self._is_wanted = self._is_wanted, wanted
        if self._is_wanted is not was:
            self._guard.trigger()

    def _listen(self) -> None:
        """Listen to TF, or no longer; for the executor's thread."""
        with self._node.setting:  # not while it is deactivated
            if self._stopping.is_set():
                return
            if self._is_wanted and self._tf is None:
                self._tf = Tf(self._node)
            elif not self._is_wanted and self._tf is not None:
                self._tf.close()
                self._tf = None

    def look(self) -> bool:
        """Publish what can be. True: a sample waits for its pose."""
        if (tf := self._tf) is None:
            for topic in self._topics:
                topic.forget()
            return False
        are_waiting = [topic.look(tf) for topic in self._topics]
        return any(are_waiting)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._clock.wait(self._arrived, _IDLE_S)
            self._arrived.clear()
            while self.look() and not self._clock.wait(self._stopping, _LOOK_S):
                pass

    def stop(self) -> bool:
        """Stop and wait for the thread; False if it does not end in time."""
        self._stopping.set()
        self._arrived.set()
        return self.thread.has_ended()


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
        elif not self._cutoff_hz and self._topic is not None:
            topic, self._topic, self.problem, self._designed = self._topic, None, "", None
            topic.close()

    def is_wanted(self) -> bool:
        """Whether it is configured and anybody has subscribed."""
        wanted = False
        with suppress(InvalidHandle):  # it has just been closed
            wanted = (topic := self._topic) is not None and topic.is_wanted()
        if not wanted and self._rate_hz():
            self._is_ready()  # so that delay or problem are told before there is a subscriber
        return wanted

    def _is_ready(self) -> bool:
        """Whether there is a filter for the current settings and sampling rate."""
        cutoff_hz, rate_hz = wanted = self._cutoff_hz, self._rate_hz()
        if not cutoff_hz:  # it has just been switched off
            return False
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
        if not rate_hz:
            raise CompensationError("the server does not report the sampling rate")
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
        if (topic := self._topic) is not None and self._is_ready():
            filtered = self._filter.step(force, torque, frame.monotonic_ns)
            with suppress(InvalidHandle):  # it has just been closed
                topic.send(*filtered, frame)


class Plan(NamedTuple):
    """What is done with a sample."""

    source: Source
    compensator: Compensator
    ramp: BiasRamp
    has_tool: bool  # whether anything has weight


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
        self, node: Node, parameters: Parameters, stamps: Stamps, rate_hz: Callable[[], float],
        clock: Clock, on_failure: Callable[[str], object],
    ) -> None:  # fmt: skip
        """ParameterError if a frame cannot be had. For `rate_hz` and `on_failure` see the parts."""
        stages = {"wrench_compensated": "final", "compensation/bias": "bias", "compensation/tool": "tool"}
        frames = make_frames(node, parameters, stamps, clock)
        self.frames = TfFrames(node, frames, clock, on_failure)
        self._filtered = FilteredTopic(node, parameters, stamps, rate_hz)
        final, *subtracted = (
            WrenchTopic(node, topic, parameters.frame_id, stamps, stage) for topic, stage in stages.items()
        )
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
        self.frames.want(self._wanted)
        self.has_subscribers = bool(self._wanted)
        if not self._wanted:
            self.is_stopped = False
        return self.has_subscribers or self.window is not None

    @property
    def problem(self) -> str:
        """Why single topics are silent, or would be with a subscriber; "" if none is."""
        return "; ".join(topic.problem for topic in self._all if topic.problem)

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

    @staticmethod
    def _stages(plan: Plan, sample: Sample, specific_force: Vector3, time_s: float) -> Stages:
        compensator = plan.compensator
        compensator.bias = plan.ramp.at(time_s)
        return compensator.compensate(sample.force, sample.torque, specific_force, plan.source.turning)
