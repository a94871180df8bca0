"""`wrench_compensated/NAME`: the compensated wrench in other frames, by a fixed pose or by TF.

TF is listened to only while somebody has subscribed to such a topic, in a callback group of its own. The
reader's thread takes what was found last, and never waits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from bridge.compensating.orientations import TF_PERIOD_S, Tf, check_tf, open_tf
from bridge.parameters.compensation import CompensationParameters
from bridge.parameters.table import Parameters
from bridge.publishing.messages import StageTopic
from ft_compensation.outputs.frames import WrenchTransform
from protocol.framing import DataMessage
from protocol.pdo import Vector3

_PATIENCE: Final = 200
"""Failed lookups after the first subscription before it is a problem: TF has to arrive first."""
_NS_PER_S: Final = 1_000_000_000


def make_frames(
    node: Node, parameters: Parameters, open_buffer: Callable[[Node], Tf] = open_tf
) -> list[StageTopic]:
    """A topic for each of the parameter `wrench_frames`; ParameterError if one needs TF and there is none."""
    by_tf = [frame.name for frame in parameters.wrench_frames if frame.fixed is None]
    topics: list[StageTopic] = [
        FixedFrameTopic(node, frame.name, frame.fixed)
        for frame in parameters.wrench_frames
        if frame.fixed is not None
    ]
    if by_tf:
        check_tf(f"parameter wrench_frames has {by_tf[0]!r} by TF", f"give its pose: '{by_tf[0]} x y z'")
        followed = [TfFrameTopic(node, name, parameters) for name in by_tf]
        TfFollower(node, followed, open_buffer)
        topics += followed
    return topics


class FixedFrameTopic(StageTopic):
    """In a frame fixed to the sensor's."""

    def __init__(self, node: Node, name: str, transform: WrenchTransform) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, "final")
        self._transform = transform

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish them in this frame."""
        super().send(*self._transform.apply(force, torque), frame)


class _Found(NamedTuple):
    transform: WrenchTransform
    stamp_ns: int
    """0: it holds at any time"""


class TfFrameTopic(StageTopic):
    """In a frame known to TF. `look_up` is for one thread, `send` for the reader's."""

    def __init__(self, node: Node, name: str, parameters: Parameters) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, "final")
        self._name, self._source = name, parameters.frame_id
        self.wanted = False
        """Whether anybody had subscribed at the last look."""
        self.on_change: Callable[[], object] = lambda: None
        """Called when that changes."""
        self._limit_ns = 0.0
        self._found: _Found | None = None
        self._error, self._misses, self._asked_ns = "", 0, 0
        self.tune(parameters.compensation)

    def tune(self, parameters: CompensationParameters) -> None:
        """Take the limit of the age."""
        self._limit_ns = parameters.orientation.stale_after * _NS_PER_S

    def is_wanted(self) -> bool:
        """Whether anybody has subscribed."""
        was, self.wanted = self.wanted, super().is_wanted()
        if self.wanted is not was:
            self.on_change()
        return self.wanted

    def look_up(self, tf: Tf) -> None:
        """Ask TF for the latest it has."""
        try:
            found: Any = tf.buffer.lookup_transform(self._name, self._source, tf.latest)
            t, q, stamp = found.transform.translation, found.transform.rotation, found.header.stamp
            transform = WrenchTransform.of((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
        except (tf.errors, ValueError) as error:
            self._error = " ".join(str(error).split())
            self._misses += 1
        else:
            self._found = _Found(transform, stamp.sec * _NS_PER_S + stamp.nanosec)

    def forget(self) -> None:
        """Forget the pose."""
        self._found, self._misses = None, 0

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish them in this frame, if its pose is known."""
        self._asked_ns = stamp_ns = frame.stamp_ns
        found = self._found
        if found is not None and (not found.stamp_ns or abs(stamp_ns - found.stamp_ns) <= self._limit_ns):
            super().send(*found.transform.apply(force, torque), frame)

    @property
    def problem(self) -> str:
        """Why nothing is published, a sentence."""
        found = self._found
        what = f"wrench_compensated/{self._name} has stopped: "
        if found is None:
            if self._misses < _PATIENCE:
                return ""
            return f"{what}TF has no pose of {self._source} in {self._name}: {self._error}"
        behind_ns = self._asked_ns - found.stamp_ns
        if not found.stamp_ns or not self._asked_ns or abs(behind_ns) <= self._limit_ns:
            return ""
        differs_s, order = abs(behind_ns) / _NS_PER_S, "older" if behind_ns > 0 else "newer"
        return (
            f"{what}TF's latest pose of {self._source} in {self._name} is {differs_s:.3g} s {order} than the "
            f"sample (limit {self._limit_ns / _NS_PER_S:g} s, orientation.stale_after)"
        )


class TfFollower:
    """Listens to TF while one of `topics` is wanted."""

    def __init__(self, node: Node, topics: Sequence[TfFrameTopic], open_buffer: Callable[[Node], Tf]) -> None:
        self._node, self._topics, self._open_buffer = node, topics, open_buffer
        self._group = MutuallyExclusiveCallbackGroup()
        self._tf: Tf | None = None
        self._timer: Any = None
        guard = node.create_guard_condition(self._follow, self._group)
        for topic in topics:
            topic.on_change = guard.trigger

    def _follow(self) -> None:
        wanted = any(topic.wanted for topic in self._topics)
        if wanted and self._tf is None:
            self._tf = self._open_buffer(self._node)
            self._timer = self._node.create_timer(TF_PERIOD_S, self._look, self._group)
        elif self._tf is not None and not wanted:
            self._node.destroy_timer(self._timer)
            self._tf.close()
            self._tf = None
            for topic in self._topics:
                topic.forget()

    def _look(self) -> None:
        tf = self._tf
        if tf is not None:
            for topic in self._topics:
                if topic.wanted:
                    topic.look_up(tf)
