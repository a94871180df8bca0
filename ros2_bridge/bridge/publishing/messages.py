"""The ROS messages, which are published in serialized form.

An output's `publish` runs in the reader's thread, for every selected sample and only while somebody has
subscribed, so it must not block and should not allocate.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from bota_ethercat.cdr import StampedNumbers
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample, Vector3
from bridge.parameters.compensation import CompensationParameters
from bridge.parameters.row import Numbers
from bridge.parameters.table import Parameters
from ft_compensation.compensator import Stages

ARRAY_LABEL: Final = "Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz"
"""The label of the array's one dimension: what its values are, in order."""
ARRAY_SIZE: Final = len(ARRAY_LABEL.split())
_NO_ORIENTATION: Final = (-1.0, *(0.0,) * 8)
"""REP 145: the covariance of a missing orientation."""
_DEPTH: Final = 10
"""Short: what a subscriber is too slow for is replaced by newer samples."""


class Output(Protocol):
    """A topic, or some that belong together, fed with every selected sample."""

    def is_wanted(self) -> bool:
        """Whether anybody is there for what `publish` does. Asked now and then, not by the reader."""

    @property
    def fields(self) -> Sequence[str]:
        """The fields of `Sample` that it publishes: all of them are finite when `publish` is called."""

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish `sample`, which came in `frame`: its stamp, and for intervals its monotonic time."""

    def follow(self, sample: Sample, frame: DataMessage) -> None:
        """Take note of a sample that `publishing_frequency` leaves out."""


class Outputs:
    """All outputs. `wanted` are those that were so at the last `refresh`."""

    def __init__(self, outputs: Sequence[Output]) -> None:
        self.all = tuple(outputs)
        self.wanted: tuple[Output, ...] = ()

    def refresh(self) -> None:
        """Look who has subscribed: 1 µs a topic, too much for every sample but not for now and then."""
        self.wanted = tuple(output for output in self.all if output.is_wanted())

    def configure(self, parameters: Parameters) -> None:
        """Pass new parameters, such as covariances, to the outputs that use them."""
        for output in self.all:
            configure = getattr(output, "configure", None)
            if configure is not None:
                configure(parameters)

    def publish_finite(self, sample: Sample, frame: DataMessage) -> None:
        """Publish a sample that is not finite everywhere where it is."""
        for output in self.wanted:
            if all(_is_finite(getattr(sample, field)) for field in output.fields):
                output.publish(sample, frame)


def create_publisher(node: Node, message_type: Any, topic: str) -> Any:
    """A reliable publisher, unless parameters override its QoS."""
    # A profile of its own each: rclpy writes what was overridden into the one it is given.
    profile = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
    options = QoSOverridingOptions.with_default_policies()
    return node.create_publisher(message_type, topic, profile, qos_overriding_options=options)


class Topic:
    """A publisher, and whether anybody has subscribed."""

    def __init__(self, node: Node, message_type: Any, topic: str) -> None:
        self.publisher = create_publisher(node, message_type, topic)
        self._publish: Callable[[bytes], None] = self.publisher.publish

    def is_wanted(self) -> bool:
        """Whether anybody has subscribed."""
        return bool(self.publisher.get_subscription_count())

    def follow(self, sample: Sample, frame: DataMessage) -> None:
        """Nothing: each message stands by itself."""


class ArrayOutput(Topic):
    """`std_msgs/Float64MultiArray`: N, Nm, m/s², rad/s, in the order of ARRAY_LABEL."""

    fields = ("force", "torque", "acceleration", "angular_rate")

    def __init__(self, node: Node, topic: str) -> None:
        super().__init__(node, Float64MultiArray, topic)
        message = Float64MultiArray()
        message.layout.dim = [
            MultiArrayDimension(label=ARRAY_LABEL, size=ARRAY_SIZE, stride=ARRAY_SIZE)
        ]  # fmt: skip
        values = struct.Struct(f"<{ARRAY_SIZE}d")
        message.data = array("d", bytes(values.size))
        self._layout, self._pack = serialize_message(message)[: -values.size], values.pack

    def publish(self, sample: Sample, frame: DataMessage) -> None:  # noqa: ARG002 - the message has no header
        """Publish the twelve values."""
        self._publish(self._layout + self._pack(*sample.array))


class WrenchTopic(Topic):
    """`geometry_msgs/WrenchStamped`: N and Nm, in the sensor's frame."""

    def __init__(self, node: Node, topic: str, frame_id: str) -> None:
        super().__init__(node, WrenchStamped, topic)
        self._pack = StampedNumbers(frame_id, 6).pack

    def send(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Publish a force and a torque."""
        self._publish(self._pack(frame.stamp_ns, *force, *torque))


class WrenchOutput(WrenchTopic):
    """The wrench as measured."""

    fields = ("force", "torque")

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish force and torque."""
        self.send(sample.force, sample.torque, frame)


class StageTopic(WrenchTopic):
    """One stage of the compensation."""

    takes_all = False

    def __init__(self, node: Node, topic: str, frame_id: str, stage: str) -> None:
        super().__init__(node, topic, frame_id)
        self.index = Stages._fields.index(stage)

    @property
    def problem(self) -> str:
        """Why nothing is published; empty, as here it always is."""
        return ""

    def tune(self, parameters: CompensationParameters) -> None:
        """Nothing."""

    def note(self, force: Vector3, torque: Vector3, frame: DataMessage) -> None:
        """Nothing."""


def make_stages(node: Node, frame_id: str) -> list[StageTopic]:
    """The topics of the compensation."""
    stages = {"wrench_compensated": "final", "compensation/bias": "bias", "compensation/tool": "tool"}
    return [StageTopic(node, name, frame_id, stage) for name, stage in stages.items()]


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
        self._send(sample, frame, (0.0, 0.0, 0.0, 1.0), _NO_ORIENTATION)

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


class TemperatureOutput(Topic):
    """`sensor_msgs/Temperature`: °C, inside the sensor."""

    fields = ("temperature",)

    def __init__(self, node: Node, topic: str, parameters: Parameters) -> None:
        super().__init__(node, Temperature, topic)
        self._pack = StampedNumbers(parameters.frame_id, 2).pack
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        """Take this variance, from any thread."""
        self._variance = parameters.temperature_variance

    def publish(self, sample: Sample, frame: DataMessage) -> None:
        """Publish the temperature."""
        self._publish(self._pack(frame.stamp_ns, sample.temperature, self._variance))


def _is_finite(value: float | Sequence[float] | None) -> bool:
    if value is None:
        return True
    return math.isfinite(sum(value) if isinstance(value, Sequence) else value)


def _covariance(values: Numbers) -> Numbers:
    """Nine numbers, row by row, from nine or from three variances."""
    if len(values) == 9:
        return values
    return tuple(values[position // 4] if position % 4 == 0 else 0.0 for position in range(9))
