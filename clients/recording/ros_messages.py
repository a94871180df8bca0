"""ROS 2 messages of a frame, as the node publishes them, serialized as CDR without ROS.

Three messages of fixed layout: a header with a constant frame_id, then doubles. mcap-ros2-support's generic
writer takes 17 times as long (21 µs a message); the node's serializer needs rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

from protocol.cdr import StampedNumbers
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import LAYOUTS, ImuUnits, Sample, SampleDecoder

_OLD: Final = int(DataFlag.REPEATED | DataFlag.INVALID)
_NS_PER_S: Final = 1_000_000_000
_MAX_STAMP_NS: Final = 2**31 * _NS_PER_S
"""A ROS time cannot represent this and later times."""

_SEPARATOR: Final = "=" * 80 + "\n"
_PARTS: Final = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Wrench": "Vector3 force\nVector3 torque\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
}


def _definition(text: str, *parts: str) -> str:
    """A complete definition for MCAP: the message, then the types that it contains."""
    used = ("std_msgs/Header", "builtin_interfaces/Time", *parts)
    return text + "".join(f"{_SEPARATOR}MSG: {part}\n{_PARTS[part]}" for part in used)


WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
IMU: Final = "sensor_msgs/msg/Imu"
TEMPERATURE: Final = "sensor_msgs/msg/Temperature"
DEFINITIONS: Final = {
    WRENCH: _definition(
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n",
        "geometry_msgs/Wrench",
        "geometry_msgs/Vector3",
    ),
    IMU: _definition(
        "std_msgs/Header header\n"
        "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
        "geometry_msgs/Quaternion",
        "geometry_msgs/Vector3",
    ),
    TEMPERATURE: _definition("std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n"),
}

_UNKNOWN: Final = (0.0,) * 9
_NO_ORIENTATION: Final = (0.0, 0.0, 0.0, 1.0, -1.0, *(0.0,) * 8)
"""REP 145: the first covariance is -1 where there is no estimate."""


class Topic(NamedTuple):
    """A ROS topic of one sensor."""

    name: str
    schema: str
    pack: Callable[[int, Sample], bytes | None]
    """The message of a stamp (ns since 1970) and a sample; None if a value is not finite, or not there."""


class RosTopics:
    """The topics of one sensor: `wrench`, `imu/data_raw`, `imu/data` and `temperature` in a namespace."""

    def __init__(self, namespace: str = "", imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        """Without a namespace names and frames are the node's own; with one the frames begin with it too."""
        head, frame = (f"/{namespace}", f"{namespace}_ft_sensor") if namespace else ("", "ft_sensor")
        self._decoders = {size: SampleDecoder(size, imu_units) for size in LAYOUTS}
        self._wrench = StampedNumbers(frame, 6)
        self._imu = StampedNumbers(f"{frame}_imu", 37)
        self._temperature = StampedNumbers(frame, 2)
        self.topics = (
            Topic(f"{head}/wrench", WRENCH, self._pack_wrench),
            Topic(f"{head}/imu/data_raw", IMU, self._pack_raw_imu),
            Topic(f"{head}/imu/data", IMU, self._pack_imu),
            Topic(f"{head}/temperature", TEMPERATURE, self._pack_temperature),
        )

    def messages(self, frame: DataMessage) -> Iterator[tuple[int, bytes]]:
        """The messages of a frame, each with its position in `topics`, if it is a new sample."""
        if frame.flags & _OLD or frame.stamp_ns >= _MAX_STAMP_NS:
            return
        sample = self._decoders[len(frame.process_data)].decode(frame.process_data)
        for position, topic in enumerate(self.topics):
            body = topic.pack(frame.stamp_ns, sample)
            if body is not None:
                yield position, body

    def _pack_wrench(self, stamp_ns: int, sample: Sample) -> bytes | None:
        return _pack_finite(self._wrench, stamp_ns, *sample.force, *sample.torque)

    def _pack_raw_imu(self, stamp_ns: int, sample: Sample) -> bytes | None:
        return self._pack_oriented(stamp_ns, sample, _NO_ORIENTATION)

    def _pack_imu(self, stamp_ns: int, sample: Sample) -> bytes | None:
        if sample.orientation is None:
            return None
        return self._pack_oriented(stamp_ns, sample, (*sample.orientation, *_UNKNOWN))

    def _pack_oriented(self, stamp_ns: int, sample: Sample, orientation: Sequence[float]) -> bytes | None:
        return _pack_finite(
            self._imu,
            stamp_ns,
            *orientation,
            *sample.angular_rate,
            *_UNKNOWN,
            *sample.acceleration,
            *_UNKNOWN,
        )

    def _pack_temperature(self, stamp_ns: int, sample: Sample) -> bytes | None:
        return _pack_finite(self._temperature, stamp_ns, sample.temperature, 0.0)


def _pack_finite(message: StampedNumbers, stamp_ns: int, *values: float) -> bytes | None:
    return message.pack(stamp_ns, *values) if math.isfinite(sum(values)) else None
