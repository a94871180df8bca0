"""The IMU's two topics (REP 145): `imu/data_raw` without an orientation, `imu/data` with one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rclpy.node import Node
from sensor_msgs.msg import Imu

from bridge.parameters.row import Numbers
from bridge.parameters.table import Parameters
from bridge.publishing.messages import Topic
from protocol.cdr import StampedNumbers
from protocol.framing import DataMessage
from protocol.pdo import Sample

_UNKNOWN: Final = (-1.0, *(0.0,) * 8)
"""REP 145: the covariance of a missing orientation."""


class RawImuOutput(Topic):
    """`imu/data_raw`: `sensor_msgs/Imu`, m/s² and rad/s."""

    name = "imu/data_raw"
    fields: tuple[str, ...] = ("acceleration", "angular_rate")

    def __init__(self, node: Node, parameters: Parameters) -> None:
        super().__init__(node, Imu, self.name)
        self._pack = StampedNumbers(parameters.imu_frame_id, 37).pack
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        """Take these covariances, from any thread."""
        self._covariances = (
            _covariance(parameters.orientation_covariance),
            _covariance(parameters.angular_velocity_covariance),
            _covariance(parameters.linear_acceleration_covariance),
        )

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish acceleration and angular rate."""
        self._send(sample, frame, (0.0, 0.0, 0.0, 1.0), _UNKNOWN)

    def _send(
        self, sample: Sample, frame: DataMessage, orientation: Sequence[float], covariance: Sequence[float]
    ) -> None:
        _, of_rate, of_acceleration = self._covariances
        self._publish(
            self._pack(
                frame.stamp_ns, *orientation, *covariance,
                *sample.angular_rate, *of_rate, *sample.acceleration, *of_acceleration,
            )
        )  # fmt: skip


class ImuOutput(RawImuOutput):
    """`imu/data`: the same with the sensor's own estimate of its orientation; nothing where there is none."""

    name = "imu/data"
    fields = (*RawImuOutput.fields, "orientation")

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish acceleration, angular rate and orientation."""
        if sample.orientation is not None:
            self._send(sample, frame, sample.orientation, self._covariances[0])


def _covariance(values: Numbers) -> Numbers:
    """Nine numbers, row by row, from nine or from three variances."""
    if len(values) == 9:
        return values
    return tuple(values[position // 4] if position % 4 == 0 else 0.0 for position in range(9))
