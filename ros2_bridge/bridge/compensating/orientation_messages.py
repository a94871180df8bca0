"""Where an orientation comes from in ROS: three kinds of message, and TF. No threads, no node.

Every source gives the same: the sensor's orientation in the base frame as a quaternion x, y, z, w (the
rotation that takes the sensor's vectors to the base's) and its time, or a sentence that says why not.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

from geometry_msgs.msg import PoseStamped, QuaternionStamped
from sensor_msgs.msg import Imu

from bridge.compensating.tool_sources import Oriented
from bridge.parameters.compensation import Quaternion
from bridge.parameters.row import ParameterError

_NORM_TOLERANCE: Final = 0.01
_NS_PER_S: Final = 1_000_000_000


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
