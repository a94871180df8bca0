# SPDX-License-Identifier: Apache-2.0
"""The inputs of the server's terminals as ROS messages: `terminal_N`, and `terminal_N/stamped` with names."""

from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from bota_ethercat.client.client import Client
from bota_ethercat.framing import TerminalMessage
from bridge.publishing.messages import create_publisher


class TerminalTopics:
    """Two topics of each terminal, fed by the reader's thread with frames that are valid."""

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
