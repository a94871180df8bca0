# SPDX-License-Identifier: Apache-2.0
"""The specific force at the tool from the robot's orientation: messages and TF. The sensor's IMU is in
`ft_compensation.imu`.

Messages of the robot have a callback group of their own, which waits for no service. TF is looked up at
intervals.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Final

from geometry_msgs.msg import PoseStamped, QuaternionStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from bota_ethercat.pdo import Sample, Vector3
from bota_ethercat_bridge.parameters.table import TOPIC_SOURCES, ParameterError, Parameters
from bota_ethercat_bridge.tf import TF_PERIOD_S, Tf, UnusableError, check_tf, stale_text, stamp_ns
from bota_ft_compensation.imu import ImuSource, Source
from bota_ft_compensation.quantities import Quaternion, unit_quaternion
from bota_ft_compensation.specific_force import QuaternionGravity

# How long an executor may take to release the previous subscription: DDS has one type per topic.
_RELEASE_S: Final = 1.0
# Type of the messages, and the quaternion in one, by the value of the parameter `gravity_source`.
TOPIC_KINDS: Final[dict[str, tuple[Any, Callable[[Any], Any]]]] = {
    "topic_pose": (PoseStamped, attrgetter("pose.orientation")),
    "topic_quaternion": (QuaternionStamped, attrgetter("quaternion")),
    "topic_imu": (Imu, attrgetter("orientation")),
}


class RobotSource(Source):
    """Gravity by the latest orientation of a topic or TF, turned on to the sample by the sensor's gyroscope.

    `update` is for the subscriber's thread; `latest` and `problem` are replaced, never changed in place.
    """

    def __init__(self, parameters: Parameters, name: str) -> None:
        super().__init__()
        self.name = name
        # The rotation that takes the sensor's vectors to the base frame, and its stamp, ns since 1970.
        self.latest: tuple[Quaternion, int] | None = None
        self.problem = ""  # why the latest message is unusable; empty if it is not
        self.why_silent: Callable[[], str] = lambda: "nothing has come yet"
        self._limit_s = parameters.orientation_stale_after
        self._gravity = QuaternionGravity(parameters.gravity, stale_after_s=self._limit_s)
        self._used: object = None

    def update(self, read: Callable[[], tuple[Quaternion, int]]) -> None:
        try:
            self.latest, self.problem = read(), ""
        except UnusableError as error:
            self.problem = str(error)

    def specific_force(self, sample: Sample, time_s: float, stamp_s: float) -> Vector3 | None:
        gravity, latest = self._gravity, self.latest
        gravity.add_rate(sample.angular_rate, time_s)
        if latest is not self._used and latest is not None:
            self._used = latest
            then_s = latest[1] * 1e-9 - stamp_s + time_s
            if not gravity.update(latest[0], then_s):
                # The publisher's clock went back, or it is another publisher: the latest counts.
                gravity.reset()
                gravity.update(latest[0], then_s)
        if (found := gravity.gravity(time_s)) is None:
            return None
        x, y, z = found
        return -x, -y, -z

    def why_none(self, sample: Sample, stamp_s: float) -> str:  # noqa: ARG002
        if self.latest is None:
            return f"no orientation from {self.name}: {self.problem or self.why_silent()}"
        stale = stale_text(stamp_s - self.latest[1] * 1e-9, self._limit_s)
        why = self.problem or "it has stopped, is slow, or has another clock"
        return stale and f"the latest orientation from {self.name} {stale}: {why}"

    def age_s(self, time_s: float) -> float:
        return self._gravity.age_s(time_s)


def check_source(node: Node, wanted: Parameters) -> None:
    if wanted.gravity_source == "tf":
        check_tf()
    if wanted.gravity_source not in TOPIC_SOURCES:
        return
    try:
        node.resolve_topic_name(wanted.orientation_topic)
    except RuntimeError as error:  # rclpy has no public name for it
        reason = str(error).removeprefix("failed to resolve name: ").partition(", at /")[0]
        text = f"parameter orientation.topic is {wanted.orientation_topic!r}: {reason}"
        raise ParameterError(text) from None


def open_source(node: Node, wanted: Parameters, group: CallbackGroup) -> Source:
    """The source that is wanted; ParameterError if that cannot be."""
    if wanted.gravity_source == "imu":
        place, gyroscope = wanted.imu_position, wanted.gyroscope_matrix
        return ImuSource(wanted.tool_center_of_gravity, place, wanted.accelerometer, gyroscope)
    if wanted.gravity_source == "tf":
        return _open_tf(node, wanted, group)
    return Source() if wanted.gravity_source == "none" else _open_topic(node, wanted, group)


def _open_tf(node: Node, wanted: Parameters, group: CallbackGroup) -> RobotSource:
    base, frame = wanted.orientation_base_frame, wanted.frame_id
    source, tf = RobotSource(wanted, f"TF from {base} to {frame}"), Tf(node)

    def read() -> tuple[Quaternion, int]:
        _, rotation, stamp = tf.look_up(base, frame)
        return rotation, stamp or time.time_ns()  # static transforms hold at any time, so now

    timer = node.create_timer(TF_PERIOD_S, lambda: source.update(read), group)
    source.close = lambda: (node.destroy_timer(timer), tf.close())
    return source


def _open_topic(node: Node, wanted: Parameters, group: CallbackGroup) -> RobotSource:
    kind, _ = TOPIC_KINDS[wanted.gravity_source]
    topic = node.resolve_topic_name(wanted.orientation_topic)
    source = RobotSource(wanted, f"topic {topic}")
    source.why_silent = lambda: _why_silent(node, topic, kind)
    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

    def on_message(message: Any) -> None:
        source.update(lambda: read_message(message, wanted))

    if topic in {publisher.topic_name for publisher in node.publishers}:  # ROS would print a hundred lines
        wrong = f"parameter orientation.topic is {wanted.orientation_topic!r}, which this node publishes"
        raise ParameterError(f"{wrong}: name the robot's")
    deadline_s = time.monotonic() + _RELEASE_S
    while True:
        try:
            listening = node.create_subscription(kind, topic, on_message, profile, callback_group=group)
            break
        except RuntimeError as error:
            if time.monotonic() < deadline_s:
                time.sleep(0.01)
                continue
            raise ParameterError(
                f"parameter orientation.topic is {wanted.orientation_topic!r}: ROS refuses to listen there "
                f"({error}); choose another topic"
            ) from None
    source.close = lambda: node.destroy_subscription(listening)
    return source


def _why_silent(node: Node, topic: str, kind: Any) -> str:
    """Why nothing has come on a topic, by who publishes there."""
    sent = sorted({publisher.topic_type for publisher in node.get_publishers_info_by_topic(topic)})
    if not sent:
        return "nobody publishes it"
    if (expected := _type_name(kind)) in sent:
        return "nothing has come on it yet"
    sources = [name for name, (other, _) in TOPIC_KINDS.items() if _type_name(other) == sent[0]]
    remedy = f": set gravity_source to {sources[0]}" if sources else ""
    return f"its publisher sends {sent[0]}, not {expected}{remedy}"


def _type_name(kind: Any) -> str:
    return f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"


def read_message(message: Any, wanted: Parameters) -> tuple[Quaternion, int]:
    """Orientation and stamp (ns) of a message of a kind of TOPIC_KINDS; UnusableError if it has none."""
    if isinstance(message, Imu) and message.orientation_covariance[0] == -1.0:
        raise UnusableError("its messages say that they have none (orientation_covariance[0] is -1)")
    if not (stamp := stamp_ns(message.header.stamp)):
        raise UnusableError("its messages have no time stamp: the publisher must fill in header.stamp")
    q = TOPIC_KINDS[wanted.gravity_source][1](message)
    try:
        return multiply(unit_quaternion((q.x, q.y, q.z, q.w)), wanted.mounting), stamp
    except ValueError as error:
        raise UnusableError(f"what it sends is none: {error}") from None


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
