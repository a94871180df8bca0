# SPDX-License-Identifier: Apache-2.0
"""The topics of compensated wrenches: plain, filtered, and in other frames.

Frames known to TF have a thread of their own, which waits for the pose at the sample's stamp.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Vector3
from bridge.parameters.table import Parameters
from bridge.process import Worker
from bridge.publishing.messages import Stamps, Topic
from bridge.rclpy_internals import packer
from bridge.stream.link import Clock
from bridge.tf import Pose, Tf, UnusableError, check_tf, stale_text
from ft_compensation.compensator import Stages
from ft_compensation.outputs import WrenchFilter, WrenchTransform
from ft_compensation.quantities import CompensationError

_PATIENCE_S: Final = 1.0  # without a pose before it is a problem: TF has to arrive first
_LOOK_UP_S: Final = 0.001  # how often TF is asked for a pose that has not come
_IDLE_S: Final = 1.0
_MOST_WAITING: Final = 2000  # samples
_NS_PER_S: Final = 1_000_000_000


class WrenchTopic(Topic):
    """`geometry_msgs/WrenchStamped` of one stage of the compensation, made by the reader's thread."""

    problem = ""  # why nothing is published, or would be with a subscriber

    def __init__(self, node: Node, topic: str, frame_id: str, stamps: Stamps, stage: str = "final") -> None:
        super().__init__(node, WrenchStamped, topic)
        self._pack, self._stamps = packer(WrenchStamped(header=Header(frame_id=frame_id)), 6), stamps
        self.index = Stages._fields.index(stage)

    def configure(self, parameters: Parameters) -> None:
        """Take other parameters from the next sample on; for the executor's thread."""

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        self._send(self._pack(frame.stamp_ns - self._stamps.wrench_ns, *force, *torque))


class FixedFrameTopic(WrenchTopic):
    def __init__(self, node: Node, name: str, transform: WrenchTransform, stamps: Stamps) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, stamps)
        self._transform = transform

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        super().send(*self._transform.apply(force, torque), frame)


class FilteredTopic(WrenchTopic):
    """`wrench_filtered`, from every sample: `publishing_frequency` comes after it."""

    def __init__(
        self, node: Node, parameters: Parameters, stamps: Stamps, rate_hz: Callable[[], float]
    ) -> None:
        """`rate_hz`: the sensor's sampling rate, 0 if it is not known."""
        super().__init__(node, "wrench_filtered", parameters.frame_id, stamps)
        self._log, self._rate_hz = node.get_logger(), rate_hz
        self._filter = WrenchFilter()
        self._designed: tuple[float, float] | None = None
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        self._cutoff_hz = parameters.filter_cutoff

    def is_wanted(self) -> bool:
        if self._rate_hz():
            self._is_ready()  # so that delay or problem are told before there is a subscriber
        return super().is_wanted()

    def _is_ready(self) -> bool:
        cutoff_hz, rate_hz = wanted = self._cutoff_hz, self._rate_hz()
        if wanted != self._designed:
            self._designed, self.problem = wanted, ""
            try:
                if not rate_hz:
                    raise CompensationError("the server does not report the sampling rate")
                self._filter.design(cutoff_hz, rate_hz)
                delay_ms = self._filter.delay_s * 1e3
                self._log.info(
                    f"wrench_filtered is delayed by {delay_ms:.1f} ms: cut-off {cutoff_hz:g} Hz, sampling "
                    f"rate {rate_hz:g} Hz"
                )
            except CompensationError as error:
                self.problem = f"wrench_filtered has stopped: {error}"
                self._log.warning(self.problem)
        return not self.problem

    def note(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Filter a sample that is not published."""
        if self._is_ready():
            self._filter.step(force, torque, frame.monotonic_ns)

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        if self._is_ready():
            super().send(*self._filter.step(force, torque, frame.monotonic_ns), frame)


class TfFrameTopic(WrenchTopic):
    """`wrench_compensated/NAME`: in a frame known to TF, by the pose at the sample's stamp.

    `send` is the reader's, and waits for nothing; `publish_waiting` and `forget` are for one other thread.
    """

    is_known = False  # whether TF has had its pose: until then it is asked for without a subscriber too

    def __init__(self, node: Node, name: str, stamps: Stamps, parameters: Parameters, clock: Clock) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, stamps)
        self._name, self._source, self._clock = name, parameters.frame_id, clock
        self.on_sample: Callable[[], object] = lambda: None
        # Samples, and until when (s, by the clock) they wait for their poses.
        self._waiting: deque[tuple[float, Vector3, Vector3, DataMessage]] = deque()
        self.configure(parameters)
        self.forget()

    def configure(self, parameters: Parameters) -> None:
        self._limit_s, self._wait_s = parameters.orientation_stale_after, parameters.tf_wait

    def forget(self) -> None:
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

    def publish_waiting(self, tf: Tf) -> bool:
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
        what = f"wrench_compensated/{self._name} has stopped: "
        if not self._found_ns:
            is_new = not self._failing_s or self._clock.monotonic() - self._failing_s < _PATIENCE_S
            return "" if is_new else what + self._error
        stale = stale_text((self._asked_ns - self._found_ns) / _NS_PER_S, self._limit_s)
        return stale and f"{what}TF's latest pose of {self._source} in {self._name} {stale}"


def make_frames(node: Node, parameters: Parameters, stamps: Stamps, clock: Clock) -> list[WrenchTopic]:
    """A topic for each of the parameter `wrench_frames`; ParameterError if one needs TF and there is none."""
    topics: list[WrenchTopic] = []
    for name, fixed in parameters.frames:
        if fixed is not None:
            topics.append(FixedFrameTopic(node, name, fixed, stamps))
        else:
            check_tf(f"parameter wrench_frames has {name!r} by TF", f"give its pose: '{name} x y z'")
            topics.append(TfFrameTopic(node, name, stamps, parameters, clock))
    return topics


class TfFrames:
    """Its `thread` publishes the topics of frames known to TF; TF is listened to while one is wanted."""

    def __init__(
        self, node: Node, topics: Sequence[WrenchTopic], clock: Clock, on_failure: Callable[[str], object]
    ) -> None:
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
        if wanted is not was:
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

    def publish_waiting(self) -> bool:
        """Publish what can be. True: a sample waits for its pose."""
        if (tf := self._tf) is None:
            for topic in self._topics:
                topic.forget()
            return False
        are_waiting = [topic.publish_waiting(tf) for topic in self._topics]
        return any(are_waiting)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._clock.wait(self._arrived, _IDLE_S)
            self._arrived.clear()
            while self.publish_waiting() and not self._clock.wait(self._stopping, _LOOK_UP_S):
                pass

    def stop(self) -> bool:
        self._stopping.set()
        self._arrived.set()
        return self.thread.has_ended()
