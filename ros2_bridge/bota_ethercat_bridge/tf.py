# SPDX-License-Identifier: Apache-2.0
"""TF, which not everybody has: `tf2_ros` is imported only where a parameter asks for it."""

from __future__ import annotations

from typing import Any, Final

from rclpy.node import Node
from rclpy.time import Time

from bota_ethercat.pdo import Vector3
from bota_ethercat_bridge.parameters.table import ParameterError
from bota_ft_compensation.quantities import Quaternion, unit_quaternion

TF_PERIOD_S: Final = 0.005  # how often poses are looked up


class UnusableError(Exception):
    """There is no pose or orientation just now; the text says why."""


def check_tf(wanted: str = "parameter gravity_source is 'tf'", instead: str = "take another source") -> None:
    """ParameterError if tf2_ros is missing. `wanted`: what needs it, `instead`: what to do without it."""
    try:
        import tf2_ros  # noqa: F401, PLC0415
    except ImportError as error:
        raise ParameterError(
            f"{wanted}: it needs tf2_ros, which cannot be loaded ({error}): "
            f"sudo apt install ros-$ROS_DISTRO-tf2-ros-py and source ROS 2, or {instead}"
        ) from None


class Tf:
    """The transforms that `node` hears, in a callback group of tf2_ros's, until `close`."""

    def __init__(self, node: Node) -> None:
        from tf2_ros import Buffer, TransformListener  # noqa: PLC0415

        self._buffer = Buffer()
        self.close = TransformListener(self._buffer, node, spin_thread=False).unregister

    def look_up(self, base: str, frame: str) -> tuple[Vector3, Quaternion, int]:
        """The latest pose of `frame` in `base`, m, and its stamp, ns since the Unix epoch; UnusableError.

        A stamp of 0 is that of a static pose, which holds at any time.
        """
        from tf2_ros import TransformException  # noqa: PLC0415

        try:
            found = self._buffer.lookup_transform(base, frame, Time())
            t, q = found.transform.translation, found.transform.rotation
            rotation = unit_quaternion((q.x, q.y, q.z, q.w))
        except (TransformException, ValueError) as error:
            why = " ".join(str(error).split())
            raise UnusableError(f"TF has no pose of {frame} in {base}: {why}") from None
        return (t.x, t.y, t.z), rotation, stamp_ns(found.header.stamp)


def stamp_ns(stamp: Any) -> int:
    """A message's time, ns since the Unix epoch; 0 if it has none."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stale_text(behind_s: float, limit_s: float) -> str:
    """That a stamp is too far from the sample's, the end of a clause; empty if it is not."""
    if abs(behind_s) <= limit_s:
        return ""
    order = "older" if behind_s > 0 else "newer"
    return f"is {abs(behind_s):.3g} s {order} than the sample (limit {limit_s:g} s, orientation.stale_after)"
