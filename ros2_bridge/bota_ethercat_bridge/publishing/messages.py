# SPDX-License-Identifier: Apache-2.0
"""The ROS messages of what the sensor measures, in serialized form, and of the server's terminals; the QoS
of every topic (`create_publisher`).

An output's `publish` runs in the reader's thread, for every selected sample and only while somebody has
subscribed, so it must not block and should not allocate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import repeat
from operator import length_hint
from typing import Any, Final

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu, JointState, Temperature
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension

from bota_ethercat.client.client import Client
from bota_ethercat.framing import DataMessage, TerminalMessage
from bota_ethercat.pdo import (
    LAYOUTS,
    MOTION,
    ORIENTATION,
    TEMPERATURE,
    WRENCH,
    ImuUnits,
    SampleDecoder,
    Values,
    Vector3,
)
from bota_ethercat.sensor.response import imu_variances
from bota_ethercat_bridge.parameters.table import Numbers, Parameters
from bota_ethercat_bridge.rclpy_internals import packing, sending
from bota_ethercat_bridge.stream.link import Link
from bota_ethercat_bridge.stream.reader import Output

# The label of the array's one dimension: what its values are, in order.
ARRAY_LABEL: Final = "Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz"
_ARRAY_SIZE: Final = len(ARRAY_LABEL.split())
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0)
_NO_ORIENTATION: Final = (-1.0, *(0.0,) * 8)  # REP 145: the covariance of a missing orientation
_DEPTH: Final = 10  # short: what a subscriber is too slow for is replaced by newer samples
_MANY: Final = 2**62
Publish = Callable[[Values, DataMessage], None]
Sends = Iterator[Callable[[bytes], None]]  # what publishes a message, once for each
Make = Callable[[Sends, Parameters, "Stamps"], Publish]


def create_publisher(node: Node, message_type: Any, topic: str) -> Any:
    """A reliable publisher, unless parameters override its QoS."""
    # A profile of its own each: rclpy writes what was overridden into the one it is given.
    profile = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
    options = QoSOverridingOptions.with_default_policies()
    return node.create_publisher(message_type, topic, profile, qos_overriding_options=options)


class Topic:
    """A publisher, whether anybody has subscribed, and how many messages it has published."""

    def __init__(self, node: Node, message_type: Any, topic: str) -> None:
        self._publisher = create_publisher(node, message_type, topic)
        self.name, self.kind = self._publisher.topic_name, message_type
        # It counts what is taken out of it: without a line of Python for each sample.
        self._sends: Sends = repeat(sending(self._publisher), _MANY)

    @property
    def published(self) -> int:
        return _MANY - length_hint(self._sends)

    def is_wanted(self) -> bool:
        return bool(self._publisher.get_subscription_count())


class Stamps:
    """How much earlier than the samples their stamps are, ns: by the parameter `stamp` and the filters.

    Also, by the filters: `covariances` of the IMU's orientation, angular rate and acceleration.
    """

    def __init__(self, log: Any) -> None:
        self.kind = "sample"  # what stamps are the time of
        self.wrench_ns = self.imu_ns = 0
        self.covariances: list[Numbers] = [_NO_ORIENTATION] * 3  # (9,) each
        self.problem = ""  # why some are not those of the measurement, a sentence
        self._log = log

    def of(self, kind: Any) -> int:
        """By how much those of messages of this type are earlier."""
        return {WrenchStamped: self.wrench_ns, Imu: self.imu_ns}.get(kind, 0)

    def update(self, parameters: Parameters, link: Link) -> None:
        self.kind = kind = parameters.stamp
        given = (
            parameters.orientation_covariance,
            parameters.angular_velocity_covariance,
            parameters.linear_acceleration_covariance,
        )
        self.covariances = list(map(_covariance, given, imu_variances(link.info.settings)))
        if not link.is_connected:
            return
        delays = {"wrench": link.info.delay_ns.force_torque, "imu": link.info.delay_ns.acceleration}
        if kind != "measurement":
            delays = dict.fromkeys(delays, 0)
        self.wrench_ns, self.imu_ns = (delay_ns or 0 for delay_ns in delays.values())
        unknown = " and ".join(topics for topics, delay_ns in delays.items() if delay_ns is None)
        problem = (
            f"stamp is measurement, but the delay of the filters is not known, so {unknown} topics have the "
            "time of the sample: switch settings.chop and settings.fast off, or update the server"
        )
        before, self.problem = self.problem, problem if unknown else ""
        if self.problem and self.problem != before:
            self._log.warning(self.problem)


class MeasuredTopic(Topic):
    """A topic of what the sensor measures; `make` gives what publishes a sample with these parameters."""

    def __init__(
        self, node: Node, parameters: Parameters, stamps: Stamps, topic: str, message_type: Any,
        parts: Sequence[slice], make: Make,
    ) -> None:  # fmt: skip
        super().__init__(node, message_type, topic)
        self.parts, self._make, self._stamps, self.topics = parts, make, stamps, [self]
        self.configure(parameters)

    def configure(self, parameters: Parameters) -> None:
        self.publish = self._make(self._sends, parameters, self._stamps)

    def observe(self, values: Values, frame: DataMessage) -> None:
        """Nothing: each message stands by itself."""


def make_measured(node: Node, parameters: Parameters, stamps: Stamps) -> list[Output]:
    topics: tuple[tuple[str, Any, Sequence[slice], Make], ...] = (
        ("wrench", WrenchStamped, (WRENCH,), _wrench),
        (parameters.array_topic, Float64MultiArray, (WRENCH, MOTION), _array),
        ("imu/data_raw", Imu, (MOTION,), _imu),
        ("imu/data", Imu, (MOTION, ORIENTATION), partial(_imu, oriented=True)),
        ("temperature", Temperature, (TEMPERATURE,), _temperature),
    )
    return [MeasuredTopic(node, parameters, stamps, *topic) for topic in topics]


def decoder(parameters: Parameters) -> SampleDecoder:
    """For `Values` of any size."""
    return SampleDecoder(min(LAYOUTS), ImuUnits(parameters.imu_raw_units))


def _array(sends: Sends, parameters: Parameters, _: Stamps) -> Publish:
    """`std_msgs/Float64MultiArray`: N, Nm, m/s², rad/s, in the order of ARRAY_LABEL; it has no header."""
    message = Float64MultiArray()
    message.layout.dim = [MultiArrayDimension(label=ARRAY_LABEL, size=_ARRAY_SIZE, stride=_ARRAY_SIZE)]
    message.data = [0.0] * _ARRAY_SIZE
    pack = packing(message, _ARRAY_SIZE)
    motion = decoder(parameters).motion

    def publish(values: Values, _: DataMessage) -> None:
        acceleration, angular_rate = motion(values)
        next(sends)(pack(*values[WRENCH], *acceleration, *angular_rate))

    return publish


def _wrench(sends: Sends, parameters: Parameters, stamps: Stamps) -> Publish:
    """`geometry_msgs/WrenchStamped`: N and Nm, in the sensor's frame."""
    pack = packing(WrenchStamped(header=Header(frame_id=parameters.frame_id)), 6)
    return lambda values, frame: next(sends)(pack(frame.stamp_ns - stamps.wrench_ns, *values[WRENCH]))


def _imu(sends: Sends, parameters: Parameters, stamps: Stamps, *, oriented: bool = False) -> Publish:
    """`sensor_msgs/Imu`: m/s² and rad/s; `oriented`: with the sensor's own estimate of its orientation, and
    nothing where there is none."""
    pack = packing(Imu(header=Header(frame_id=parameters.imu_frame_id)), 37)
    motion = decoder(parameters).motion

    def publish(values: Values, frame: DataMessage) -> None:
        orientation = values[ORIENTATION] if oriented else _UPRIGHT
        if any(orientation):
            acceleration, angular_rate = motion(values)
            of_orientation, of_rate, of_acceleration = stamps.covariances
            next(sends)(
                pack(
                    frame.stamp_ns - stamps.imu_ns,
                    *orientation, *(of_orientation if oriented else _NO_ORIENTATION),
                    *angular_rate, *of_rate, *acceleration, *of_acceleration,
                )
            )  # fmt: skip

    return publish


def _temperature(sends: Sends, parameters: Parameters, _: Stamps) -> Publish:
    """`sensor_msgs/Temperature`: °C, inside the sensor."""
    pack = packing(Temperature(header=Header(frame_id=parameters.frame_id)), 2)
    variance = parameters.temperature_variance
    return lambda values, frame: next(sends)(pack(frame.stamp_ns, *values[TEMPERATURE], variance))


def _covariance(given: Vector3, typical: Vector3) -> Numbers:
    x, y, z = (variance or usual for variance, usual in zip(given, typical, strict=True))
    return x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z


class TerminalTopics:
    """`terminal_N`, and `terminal_N/stamped` with names, fed by the reader's thread with valid frames."""

    def __init__(self, node: Node, count: int, client: Client) -> None:
        self._client = client
        types = {"": Float64MultiArray, "/stamped": JointState}
        self._topics = [
            [create_publisher(node, kind, f"terminal_{n}{name}") for name, kind in types.items()]
            for n in range(count)
        ]

    def publish(self, frame: TerminalMessage) -> None:
        """All entries in the order of the process data, as numbers without a unit."""
        values = self._client.decode_terminal(frame)
        names, numbers, size = list(values), list(map(float, values.values())), len(values)
        for topic in self._topics[frame.sensor] if frame.sensor < len(self._topics) else ():
            if not topic.get_subscription_count():
                continue
            if topic.msg_type is JointState:
                message = JointState(name=names, position=numbers)
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(frame.stamp_ns, 10**9)
            else:
                message = Float64MultiArray(data=numbers)
                message.layout.dim = [MultiArrayDimension(label=", ".join(names), size=size, stride=size)]
            topic.publish(message)
