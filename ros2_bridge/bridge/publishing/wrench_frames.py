"""`wrench_compensated/NAME`: the compensated wrench in other frames, by a fixed pose or by TF.

TF is listened to only while somebody has subscribed to such a topic, in a callback group of its own. The
reader's thread takes what was found last, and never waits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Vector3
from bridge.parameters.compensation import CompensationParameters
from bridge.parameters.table import Parameters
from bridge.publishing.messages import StageTopic
from bridge.transforms import Tf, UnusableError, check_tf, follow_tf, look_up
from ft_compensation.outputs.frames import WrenchTransform

_PATIENCE: Final = 200
"""Failed lookups after the first subscription before it is a problem: TF has to arrive first."""
_NS_PER_S: Final = 1_000_000_000


def make_frames(node: Node, parameters: Parameters) -> list[StageTopic]:
    """A topic for each of the parameter `wrench_frames`; ParameterError if one needs TF and there is none."""
    by_tf = [frame.name for frame in parameters.wrench_frames if frame.fixed is None]
    if by_tf:
        check_tf(f"parameter wrench_frames has {by_tf[0]!r} by TF", f"give its pose: '{by_tf[0]} x y z'")
    followed = [TfFrameTopic(node, name, parameters) for name in by_tf]
    if followed:
        follow(node, followed)
    fixed = [(frame.name, frame.fixed) for frame in parameters.wrench_frames if frame.fixed is not None]
    return [*(FixedFrameTopic(node, *each) for each in fixed), *followed]


class FixedFrameTopic(StageTopic):
    """In a frame fixed to the sensor's."""

    def __init__(self, node: Node, name: str, transform: WrenchTransform) -> None:
        super().__init__(node, f"wrench_compensated/{name}", name, "final")
        self._transform = transform

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish them in this frame."""
        super().send(*self._transform.apply(force, torque), frame)


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
        self._found: tuple[WrenchTransform, int] | None = None  # 0: it holds at any time
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
            translation, rotation, stamp_ns = look_up(tf, self._name, self._source)
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
    def problem(self) -> str:
        """Why nothing is published, a sentence."""
        what = f"wrench_compensated/{self._name} has stopped: "
        if self._found is None:
            return "" if self._misses < _PATIENCE else what + self._error
        behind_ns = self._asked_ns - self._found[1]
        if not self._found[1] or not self._asked_ns or abs(behind_ns) <= self._limit_ns:
            return ""
        differs_s, order = abs(behind_ns) / _NS_PER_S, "older" if behind_ns > 0 else "newer"
        return (
            f"{what}TF's latest pose of {self._source} in {self._name} is {differs_s:.3g} s {order} than the "
            f"sample (limit {self._limit_ns / _NS_PER_S:g} s, orientation.stale_after)"
        )


def follow(node: Node, topics: Sequence[TfFrameTopic]) -> None:
    """Listen to TF while one of `topics` is wanted."""
    group, close = MutuallyExclusiveCallbackGroup(), list[Callable[[], None]]()

    def look(tf: Tf) -> None:
        for topic in topics:
            if topic.wanted:
                topic.look_up(tf)

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
