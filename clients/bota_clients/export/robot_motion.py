"""How fast a robot turned, from a bag: by an IMU topic, or by joint states and the robot's URDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.export.frame_times import messages, stamp_ns
from bota_clients.recording.columns import Ints

Array = npt.NDArray[np.float64]
_TURNING: Final = ("revolute", "continuous")
_STILL: Final = ("fixed", "prismatic")


class _Joint(NamedTuple):
    name: str
    kind: str
    origin: Array  # (3, 3) rotation from the joint's frame to the parent's, at position 0
    axis: Array  # (3,) of length 1, in the joint's frame


def angular_rates(bag: Path, topic: str, urdf: Path | None, link: str | None) -> tuple[Ints, Array]:
    """Stamps (n,), ns by the robot's clock, and angular rates (n, 3), rad/s; RecordingError.

    Of `link` in its own frame by sensor_msgs/JointState, or as sensor_msgs/Imu has them.
    """
    stamps, rows = list[int](), list[list[float]]()
    joints = [] if urdf is None or link is None else _chain(urdf, link)
    turning = [joint.name for joint in joints if joint.kind in _TURNING]
    for message in messages(bag, topic):
        if hasattr(message, "angular_velocity"):
            rate = message.angular_velocity
            row = [rate.x, rate.y, rate.z]
        elif not hasattr(message, "position") or not hasattr(message, "name"):
            raise RecordingError(
                f"messages of {topic} are neither sensor_msgs/Imu nor sensor_msgs/JointState"
            )
        elif not joints:
            raise RecordingError(f"messages of {topic} are joint states: give --urdf and --link")
        else:
            at = dict(zip(message.name, message.position, strict=False))
            if at.keys().isdisjoint(turning):  # of another part of the robot, a gripper say
                continue
            if missing := [name for name in turning if name not in at]:
                raise RecordingError(f"messages of {topic} are without joint {missing[0]} of {urdf}")
            row = [at[name] for name in turning]
        stamps.append(stamp_ns(message, topic))
        rows.append(row)
    times, values = np.array(stamps, np.int64), np.array(rows)
    usable = np.append(True, np.diff(times) > 0) if len(times) else np.zeros(0, bool)
    times, values = times[usable], values[usable]
    if len(times) < 2:
        raise RecordingError(f"{bag} has too few messages of {topic}")
    return times, _of_link(joints, (times - times[0]) * 1e-9, values) if joints else values


def _chain(urdf: Path, link: str) -> list[_Joint]:
    """The joints from `link` to the root."""
    try:
        root = ElementTree.parse(urdf).getroot()  # noqa: S314 - a file of the user's
    except (OSError, ElementTree.ParseError) as error:
        raise RecordingError(f"{urdf} cannot be read as URDF: {error}") from None
    above: dict[str, tuple[str, _Joint]] = {}
    for joint in root.iter("joint"):
        child, parent = joint.find("child"), joint.find("parent")
        if child is None or parent is None:  # of a transmission, or of ros2_control
            continue
        name, kind = joint.get("name", ""), joint.get("type", "")
        origin, axis = (
            np.array([float(number) for number in _text(joint, tag, key, default).split()])
            for tag, key, default in (("origin", "rpy", "0 0 0"), ("axis", "xyz", "1 0 0"))
        )
        size = float(np.linalg.norm(axis)) or 1.0
        above[child.get("link", "")] = parent.get("link", ""), _Joint(name, kind, _rpy(origin), axis / size)
    found = []
    while link in above:
        link, each = above.pop(link)
        found.append(each)
        if each.kind not in _TURNING + _STILL:
            raise RecordingError(f"{urdf}: joint {each.name} is {each.kind}, which is not supported")
    if not any(joint.kind in _TURNING for joint in found):
        raise RecordingError(f"{urdf} has no joint that turns link {link}")
    return found


def _text(joint: ElementTree.Element, tag: str, key: str, default: str) -> str:
    found = joint.find(tag)
    return default if found is None else found.get(key, default)


def _rpy(angles: Array) -> Array:
    roll, pitch, yaw = (_turned(np.eye(3)[axis], angles[axis : axis + 1])[0] for axis in range(3))
    return np.asarray(yaw @ pitch @ roll)


def _turned(axis: Array, angles: Array) -> Array:
    """(n, 3, 3) rotations about an axis of length 1, rad."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross))


def _of_link(joints: list[_Joint], times: Array, positions: Array) -> Array:
    """(n, 3) rad/s in the frame of the link: the sum of what each joint turns, from the link to the root."""
    rates = np.gradient(positions, times, axis=0)
    total = np.zeros((len(times), 3))
    to_joint: Any = np.eye(3)[np.newaxis]  # rotation from the link's frame to the joint's
    column = 0
    for joint in joints:
        if joint.kind in _TURNING:
            total += rates[:, column, np.newaxis] * (joint.axis @ to_joint)
            to_joint = _turned(joint.axis, positions[:, column]) @ to_joint
            column += 1
        to_joint = joint.origin @ to_joint
    return total
