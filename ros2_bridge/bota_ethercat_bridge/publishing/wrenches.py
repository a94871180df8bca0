# SPDX-License-Identifier: Apache-2.0
"""The topics of compensated wrenches: plain, filtered, and in other frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from geometry_msgs.msg import WrenchStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Vector3
from bota_ethercat_bridge.parameters.table import Parameters
from bota_ethercat_bridge.publishing.messages import Stamps, Topic
from bota_ethercat_bridge.rclpy_internals import packing
from bota_ethercat_bridge.stream.link import NodeClock
from bota_ethercat_bridge.tf import TF_PERIOD_S, Tf, UnusableError, check_tf, stale_text
from bota_ft_compensation.compensator import Stages
from bota_ft_compensation.outputs import WrenchFilter, WrenchTransform
from bota_ft_compensation.quantities import CompensationError

_PATIENCE_S: Final = 1.0  # without a pose before it is a problem: TF has to arrive first


class WrenchTopic(Topic):
    """`geometry_msgs/WrenchStamped` of one stage of the compensation, made by the reader's thread."""

    problem = ""  # why nothing is published, or would be with a subscriber

    def __init__(self, node: Node, topic: str, frame_id: str, stamps: Stamps, stage: str = "final") -> None:
        super().__init__(node, WrenchStamped, topic)
        message, self._stamps = WrenchStamped(header=Header(frame_id=frame_id)), stamps
        self._pack = packing(message, 6)
        self.index = Stages._fields.index(stage)

    def configure(self, parameters: Parameters) -> None:
        """Take other parameters from the next sample on; for the executor's thread."""

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        next(self._sends)(self._pack(frame.stamp_ns - self._stamps.wrench_ns, *force, *torque))


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
    """`wrench_compensated/NAME`: in a frame known to TF, by its latest pose, which `look_up` replaces."""

    def __init__(
        self, node: Node, name: str, stamps: Stamps, parameters: Parameters, clock: NodeClock
    ) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, stamps)
        self._name, self._source, self._clock = name, parameters.frame_id, clock
        # The pose's stamp and what follows from it; None: TF has had none yet.
        self._pose: tuple[int, WrenchTransform] | None = None
        self._error, self._since_s = "", 0.0  # why there is none, and since when
        self.age_s: float | None = None  # of the pose, at the latest sample's stamp
        self.configure(parameters)

    @property
    def is_known(self) -> bool:
        """Whether TF has had its pose: until then it is asked for without a subscriber too."""
        return self._pose is not None

    def configure(self, parameters: Parameters) -> None:
        self._limit_s = parameters.orientation_stale_after

    def look_up(self, tf: Tf) -> None:
        """Take the latest pose; for the executor's thread."""
        try:
            translation, rotation, stamp_ns = tf.look_up(self._name, self._source)
            self._pose = stamp_ns, WrenchTransform.of(translation, rotation)
        except UnusableError as error:
            self._error, self._since_s = str(error), self._since_s or self._clock.monotonic()

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        if self._pose is None:
            return
        stamp_ns, transform = self._pose
        self.age_s = (frame.stamp_ns - stamp_ns) * 1e-9 if stamp_ns else 0.0  # a static one is of any time
        if abs(self.age_s) <= self._limit_s:
            super().send(*transform.apply(force, torque), frame)

    @property
    def problem(self) -> str:  # type: ignore[override]
        what = f"wrench_compensated/{self._name} has stopped: "
        if self._pose is None:
            is_new = not self._since_s or self._clock.monotonic() - self._since_s < _PATIENCE_S
            return "" if is_new else what + self._error
        stale = stale_text(self.age_s or 0.0, self._limit_s)
        return stale and f"{what}TF's latest pose of {self._source} in {self._name} {stale}"


def make_frames(node: Node, parameters: Parameters, stamps: Stamps, clock: NodeClock) -> list[WrenchTopic]:
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
    """The topics of frames known to TF, which is listened to while one of them is wanted."""

    def __init__(self, node: Node, topics: Sequence[WrenchTopic]) -> None:
        self._node = node
        self._topics = [topic for topic in topics if isinstance(topic, TfFrameTopic)]
        self._is_wanted = self._is_closed = False
        self._close: Callable[[], object] | None = None  # stops listening
        self._group = MutuallyExclusiveCallbackGroup()
        self._guard = node.create_guard_condition(self._listen, self._group)

    @property
    def age_s(self) -> float | None:
        """The largest age of a pose, s; None while there is none."""
        return max((abs(topic.age_s) for topic in self._topics if topic.age_s is not None), default=None)

    def want(self, topics: Sequence[object]) -> None:
        """These are wanted, among others; from any thread."""
        wanted = any(topic in topics or not topic.is_known for topic in self._topics)
        was, self._is_wanted = self._is_wanted, wanted
        if wanted is not was:
            self._guard.trigger()

    def close(self) -> None:
        self._is_closed = True
        self._listen()

    def _listen(self) -> None:
        """Listen to TF, or no longer."""
        node = self._node
        with node.setting:  # not while it is deactivated
            wanted = self._is_wanted and not self._is_closed
            if wanted and self._close is None:
                tf = Tf(node)
                timer = node.create_timer(TF_PERIOD_S, lambda: self._look_up(tf), self._group)
                self._close = lambda: (node.destroy_timer(timer), tf.close())
            elif not wanted and self._close is not None:
                self._close()
                self._close = None

    def _look_up(self, tf: Tf) -> None:
        for topic in self._topics:
            topic.look_up(tf)
