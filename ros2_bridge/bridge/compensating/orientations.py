"""The sensor's orientation from ROS: three kinds of message, or TF.

Every source gives the same: the sensor's orientation in the base frame as a quaternion x, y, z, w (the
rotation that takes the sensor's vectors to the base's) and its time, or a sentence that says why not. They
are listened to in a callback group of its own, which waits for no service: a pose that is not taken is old.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

from geometry_msgs.msg import PoseStamped, QuaternionStamped
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from bridge.compensating.tool_sources import ImuSource, ListenerSource, NoSource, Oriented, Source
from bridge.parameters.compensation import (
    TOPIC_SOURCES,
    CompensationParameters,
    OrientationParameters,
    Quaternion,
)
from bridge.parameters.row import ParameterError
from protocol.pdo import Vector3
from protocol.sensor.frames import IMU_HEIGHTS

_NORM_TOLERANCE: Final = 0.01
_NS_PER_S: Final = 1_000_000_000
TF_PERIOD_S: Final = 0.005
"""Period of the TF lookups."""
_LET_GO_S: Final = 1.0
"""How long an executor may take to release the previous subscription: DDS has one type per topic."""


class UnusableError(Exception):
    """There is no orientation to be had just now; the text says why."""


class TopicKind(NamedTuple):
    """A kind of message that carries an orientation."""

    type: Any
    quaternion: Callable[[Any], Any]
    """The quaternion in a message."""


TOPIC_KINDS: Final = {
    "topic_pose": TopicKind(PoseStamped, lambda message: message.pose.orientation),
    "topic_quaternion": TopicKind(QuaternionStamped, lambda message: message.quaternion),
    "topic_imu": TopicKind(Imu, lambda message: message.orientation),
}
"""By the value of the parameter `gravity_source`."""


def read_message(kind: TopicKind, message: Any) -> Oriented:
    """The orientation in a message; UnusableError if it has none that can be used."""
    if kind.type is Imu and message.orientation_covariance[0] == -1.0:
        raise UnusableError("its messages say that they have none (orientation_covariance[0] is -1)")
    stamp = message.header.stamp
    if not stamp.sec and not stamp.nanosec:
        raise UnusableError("its messages have no time stamp: the publisher must fill in header.stamp")
    return Oriented(unit(kind.quaternion(message)), stamp.sec * _NS_PER_S + stamp.nanosec)


def unit(q: Any) -> Quaternion:
    """A message's quaternion, made exactly one long; UnusableError if it is not nearly so."""
    norm = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:  # a NaN is not either
        raise UnusableError(f"what it sends is no rotation: a quaternion of length {norm:g} instead of 1")
    return q.x / norm, q.y / norm, q.z / norm, q.w / norm


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation that first turns by `b`, then by `a`."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


class TransformBuffer(Protocol):
    """The part of `tf2_ros.Buffer` that is used here."""

    def lookup_transform(self, target_frame: str, source_frame: str, time: Any) -> Any:
        """A TransformStamped that takes vectors of `source_frame` to `target_frame`."""


class Tf(NamedTuple):
    """What is used of tf2_ros."""

    buffer: TransformBuffer
    errors: type[Exception]
    """What a lookup raises."""
    latest: Any
    """The time that stands for the latest there is."""
    close: Callable[[], object] = lambda: None
    """Ends listening."""


def look_up(tf: Tf, base: str, frame: str) -> Oriented:
    """The orientation of `frame` in `base` by TF, the latest there is; UnusableError if there is none."""
    try:
        found = tf.buffer.lookup_transform(base, frame, tf.latest)
    except tf.errors as error:
        raise UnusableError(f"TF has no pose of {frame} in {base}: {' '.join(str(error).split())}") from None
    stamp = found.header.stamp
    stamp_ns = stamp.sec * _NS_PER_S + stamp.nanosec
    # A chain of static transforms only has no time: it holds at any, so now.
    return Oriented(unit(found.transform.rotation), stamp_ns or time.time_ns())


def check_tf(wanted: str = "parameter gravity_source is 'tf'", instead: str = "take another source") -> None:
    """ParameterError if tf2_ros is missing. `wanted`: what needs it, `instead`: what to do without it."""
    try:
        import tf2_ros  # noqa: F401, PLC0415 - only where it is asked for: not everybody has it
    except ImportError as error:
        raise ParameterError(
            f"{wanted}: it needs tf2_ros, which cannot be loaded ({error}): "
            f"sudo apt install ros-$ROS_DISTRO-tf2-ros-py and source ROS 2, or {instead}"
        ) from None


def open_tf(node: Any) -> Tf:
    """A buffer that `node` fills from /tf and /tf_static as it spins, in a callback group of tf2_ros's."""
    from rclpy.time import Time  # noqa: PLC0415
    from tf2_ros import Buffer, TransformException, TransformListener  # noqa: PLC0415 - see check_tf

    buffer = Buffer()
    listener = TransformListener(buffer, node, spin_thread=False)
    return Tf(buffer, TransformException, Time(), listener.unregister)


def check_can_listen(
    node: Node, chosen: OrientationParameters, listening: OrientationListener | None = None
) -> None:
    """ParameterError if that source is not available on this machine, or its topic's name is invalid.

    `listening` is what will be closed before.
    """
    if chosen.source == "tf":
        check_tf()
    if chosen.source in TOPIC_SOURCES:
        try:
            resolved = node.resolve_topic_name(chosen.topic)
        except RuntimeError as error:  # rclpy has no public name for it
            reason = str(error).removeprefix("failed to resolve name: ").partition(", at /")[0]
            raise ParameterError(f"parameter orientation.topic is {chosen.topic!r}: {reason}") from None
        wanted = TOPIC_KINDS[chosen.source].type
        for own in (*node.publishers, *node.subscriptions):
            # DDS has one type for a topic in a process.
            if listening is not None and own is listening.subscription:
                continue
            if own.topic_name == resolved and own.msg_type is not wanted:
                raise ParameterError(
                    f"parameter orientation.topic is {chosen.topic!r}: this node itself has that topic, with "
                    f"{own.msg_type.__name__} messages and not {wanted.__name__}"
                )


class OrientationListener:
    """From construction to `close`. Read `latest` and `problem` from any thread: they are replaced."""

    def __init__(
        self,
        node: Node,
        chosen: OrientationParameters,
        frame: str,
        group: CallbackGroup,
        open_buffer: Callable[[Node], Tf] = open_tf,
    ) -> None:
        """`chosen.source` is a key of TOPIC_KINDS, or `tf`: then `frame` is the sensor's.

        ParameterError if ROS refuses to listen there.
        """
        self.latest: Oriented | None = None
        self.problem = "nothing has come yet"
        """What was wrong with what came last; empty if nothing was."""
        self.subscription: Any = None
        """To a topic; None: to TF."""
        self._node, self._group = node, group
        self._close: Callable[[], object]
        if chosen.source == "tf":
            self._mounting = None
            self._listen_to_tf(open_buffer(node), chosen.base_frame, frame)
        else:
            self._mounting = chosen.mounting
            self._listen_to_topic(chosen)

    def _listen_to_tf(self, tf: Tf, base: str, frame: str) -> None:
        self.describe = f"TF from {base} to {frame}"
        timer = self._node.create_timer(
            TF_PERIOD_S, lambda: self._take(lambda: look_up(tf, base, frame)), self._group
        )

        def close() -> None:
            self._node.destroy_timer(timer)
            tf.close()

        self._close = close

    def _listen_to_topic(self, chosen: OrientationParameters) -> None:
        kind = TOPIC_KINDS[chosen.source]
        resolved = self._node.resolve_topic_name(chosen.topic)
        self.describe = f"topic {resolved}"
        self.problem = "nothing has come on it yet"
        profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        deadline_s = time.monotonic() + _LET_GO_S
        while self.subscription is None:
            try:
                self.subscription = self._node.create_subscription(
                    kind.type,
                    resolved,
                    lambda message: self._take(lambda: read_message(kind, message)),
                    profile,
                    callback_group=self._group,
                )
            except RuntimeError as error:
                if time.monotonic() < deadline_s:
                    time.sleep(0.01)
                    continue
                raise ParameterError(
                    f"parameter orientation.topic is {chosen.topic!r}: ROS refuses to listen there "
                    f"({error}); choose another topic"
                ) from None
        self._close = lambda: self._node.destroy_subscription(self.subscription)

    def close(self) -> None:
        """Stop listening."""
        self._close()

    def _take(self, read: Callable[[], Oriented]) -> None:
        try:
            found = read()
        except UnusableError as error:
            self.problem = str(error)
        else:
            quaternion = found.quaternion
            if self._mounting is not None:
                quaternion = multiply(quaternion, self._mounting)
            self.latest, self.problem = Oriented(quaternion, found.stamp_ns), ""


class SourceChoice:
    """The source in force, and what outlives it."""

    def __init__(self, node: Node, frame: str) -> None:
        """`frame` is the sensor's, for TF."""
        self.source: Source = NoSource()
        self.listener: OrientationListener | None = None
        """The listener of a source that uses a topic or TF."""
        self._node, self._frame = node, frame
        self._listening = MutuallyExclusiveCallbackGroup()

    def check(self, wanted: CompensationParameters) -> None:
        """ParameterError if it is not available on this machine."""
        check_can_listen(self._node, wanted.orientation, self.listener)

    def open(self, wanted: CompensationParameters, model: str) -> None:
        """Open the source that is wanted, for a sensor of this model; ParameterError if that cannot be."""
        self.close()
        name = wanted.orientation.source
        if name == "none":
            self.source = NoSource()
        elif name == "imu":
            self.source = ImuSource(wanted, imu_position(wanted, model))
        else:
            self.listener = OrientationListener(self._node, wanted.orientation, self._frame, self._listening)
            self.source = ListenerSource(wanted, self.listener)

    def close(self) -> None:
        """Stop listening for orientations."""
        if self.listener is not None:
            self.listener.close()
            self.listener = None


def imu_position(wanted: CompensationParameters, model: str) -> Vector3:
    """The IMU's position in frame_id, m: as given, else as the drawings of the model have it."""
    if any(wanted.imu_position):
        return wanted.imu_position
    return 0.0, 0.0, IMU_HEIGHTS.get(model[4:8], 0.0)


def is_same_source(one: CompensationParameters, other: CompensationParameters) -> bool:
    """Whether they ask for the same source."""
    parts = [
        (each.orientation, each.accelerometer, each.gravity, each.imu_position, each.payload)
        for each in (one, other)
    ]
    return parts[0] == parts[1]
