"""The ROS messages: each made once, then refilled and published.

An output is anything with `publish(sample, stamp_ns)`. It runs in the reader's thread, so it must not block.
"""

from __future__ import annotations

import math
from array import array
from typing import Protocol

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from protocol.pdo import Sample

ARRAY_LABEL = "Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz"
"""The label of the array's one dimension: what its values are, in order."""
ARRAY_SIZE = len(ARRAY_LABEL.split())
QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""Reliable and short: what a subscriber is too slow for is replaced by newer samples."""


class Output(Protocol):
    """One topic that is fed with every selected sample."""

    def publish(self, sample: Sample, stamp_ns: int) -> bool:
        """Publish `sample`; False if it holds a number that is not finite, and so was not published.

        `stamp_ns` is the sample's time, ns since the Unix epoch.
        """


class ArrayOutput:
    """`std_msgs/Float64MultiArray`: N, Nm, m/s², rad/s, in the order of ARRAY_LABEL."""

    def __init__(self, node: Node, topic: str) -> None:
        self._publisher = node.create_publisher(
            Float64MultiArray,
            topic,
            QOS,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._message = Float64MultiArray()
        self._message.layout.dim = [
            MultiArrayDimension(label=ARRAY_LABEL, size=ARRAY_SIZE, stride=ARRAY_SIZE)
        ]  # fmt: skip
        self._message.data = array("d", bytes(8 * ARRAY_SIZE))
        self._data: array[float] = self._message.data

    def publish(self, sample: Sample, stamp_ns: int) -> bool:  # noqa: ARG002 - the message has no header
        """Publish the twelve values."""
        values = sample.array
        # A NaN or an infinity survives every sum, and float32 values cannot add up to one.
        if not math.isfinite(sum(values)):
            return False
        if self._publisher.get_subscription_count():
            self._data[:] = array("d", values)
            self._publisher.publish(self._message)
        return True
