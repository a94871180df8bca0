"""TF, looked up at intervals: the sensor's orientation in the base, and other frames of the wrench."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from bota_ethercat.pdo import Vector3
from bridge.parameters.row import ParameterError
from ft_compensation.quantities import Quaternion, unit_quaternion

TF_PERIOD_S: Final = 0.005
_NS_PER_S: Final = 1_000_000_000


class UnusableError(Exception):
    """There is no pose or orientation to be had just now; the text says why."""


class Tf(NamedTuple):
    """What is used of tf2_ros."""

    buffer: Any
    """A `tf2_ros.Buffer`."""
    errors: type[Exception]
    """What a lookup raises."""
    latest: Any
    """The time that stands for the latest there is."""


class Pose(NamedTuple):
    """Of a frame in another."""

    translation: Vector3
    rotation: Quaternion
    stamp_ns: int
    """Since the Unix epoch; 0: static, it holds at any time."""


def stamp_ns(stamp: Any) -> int:
    """A message's time, ns since the Unix epoch; 0 if it has none."""
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def look_up(tf: Tf, base: str, frame: str) -> Pose:
    """The pose of `frame` in `base`, the latest that TF has; UnusableError if there is none."""
    try:
        found = tf.buffer.lookup_transform(base, frame, tf.latest)
        t, q = found.transform.translation, found.transform.rotation
        rotation = unit_quaternion((q.x, q.y, q.z, q.w))
    except (tf.errors, ValueError) as error:
        raise UnusableError(f"TF has no pose of {frame} in {base}: {' '.join(str(error).split())}") from None
    return Pose((t.x, t.y, t.z), rotation, stamp_ns(found.header.stamp))


def check_tf(wanted: str = "parameter gravity_source is 'tf'", instead: str = "take another source") -> None:
    """ParameterError if tf2_ros is missing. `wanted`: what needs it, `instead`: what to do without it."""
    try:
        import tf2_ros  # noqa: F401, PLC0415 - only where it is asked for: not everybody has it
    except ImportError as error:
        raise ParameterError(
            f"{wanted}: it needs tf2_ros, which cannot be loaded ({error}): "
            f"sudo apt install ros-$ROS_DISTRO-tf2-ros-py and source ROS 2, or {instead}"
        ) from None


def follow_tf(node: Node, group: CallbackGroup, look: Callable[[Tf], object]) -> Callable[[], None]:
    """Listen to TF, in a callback group of tf2_ros's, and call `look` every TF_PERIOD_S, until what is
    returned is called."""
    from rclpy.time import Time  # noqa: PLC0415
    from tf2_ros import Buffer, TransformException, TransformListener  # noqa: PLC0415 - see check_tf

    buffer = Buffer()
    listener = TransformListener(buffer, node, spin_thread=False)
    tf = Tf(buffer, TransformException, Time())
    timer = node.create_timer(TF_PERIOD_S, lambda: look(tf), group)

    def close() -> None:
        node.destroy_timer(timer)
        listener.unregister()

    return close
