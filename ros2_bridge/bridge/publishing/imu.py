"""The IMU's two topics (REP 145): `imu/data_raw` without an orientation, `imu/data` with one."""

from __future__ import annotations

from typing import Final

from rclpy.node import Node
from sensor_msgs.msg import Imu

from bridge.parameters.row import Numbers
from bridge.parameters.table import Parameters
from bridge.publishing.messages import Topic
from bridge.publishing.serialized import SerializedMessage, axes
from protocol.framing import DataMessage
from protocol.pdo import Sample

_UNKNOWN: Final = [-1.0, *[0.0] * 8]
"""REP 145: the covariance of a missing orientation."""


class RawImuOutput(Topic):
    """`imu/data_raw`: `sensor_msgs/Imu`, m/s² and rad/s."""

    name = "imu/data_raw"
    fields: tuple[str, ...] = ("acceleration", "angular_rate")

    def __init__(self, node: Node, parameters: Parameters) -> None:
        super().__init__(node, Imu, self.name)
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        """Take these covariances, from any thread."""
        message = Imu()
        message.header.frame_id = parameters.imu_frame_id
        message.orientation_covariance = self._orientation_covariance(parameters)
        message.angular_velocity_covariance = _covariance(parameters.angular_velocity_covariance)
        message.linear_acceleration_covariance = _covariance(parameters.linear_acceleration_covariance)
        positions = [
            axes(message.linear_acceleration),
            axes(message.angular_velocity),
            axes(message.orientation, "xyzw"),
        ]
        serialized = SerializedMessage(message, positions, message.header.stamp)
        serialized.fill(2, (0.0, 0.0, 0.0, 1.0))
        self._serialized = serialized

    def _orientation_covariance(self, parameters: Parameters) -> list[float]:  # noqa: ARG002
        return _UNKNOWN

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish acceleration and angular rate."""
        serialized = self._serialized
        serialized.stamp(frame.stamp_ns)
        serialized.fill(0, sample.acceleration)
        serialized.fill(1, sample.angular_rate)
        self._publish(serialized.message())


class ImuOutput(RawImuOutput):
    """`imu/data`: the same with the sensor's own estimate of its orientation; nothing where there is none."""

    name = "imu/data"
    fields = (*RawImuOutput.fields, "orientation")

    def _orientation_covariance(self, parameters: Parameters) -> list[float]:
        return _covariance(parameters.orientation_covariance)

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish acceleration, angular rate and orientation."""
        if sample.orientation is not None:
            self._serialized.fill(2, sample.orientation)
            super().publish(sample, frame)


def _covariance(values: Numbers) -> list[float]:
    """Nine numbers, row by row, from nine or from three variances."""
    if len(values) == 9:
        return list(values)
    return [values[position // 4] if position % 4 == 0 else 0.0 for position in range(9)]
