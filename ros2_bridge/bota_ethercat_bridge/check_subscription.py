# SPDX-License-Identifier: Apache-2.0
"""`ros2 run bota_ethercat_bridge check_subscription TOPIC`: what a subscriber of a topic of the node loses
on this machine, how old its messages are, and what to change.

Exit codes: 0 nothing lost, 1 something lost or nothing received, 2 wrong arguments.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from typing import Any, Final

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from bota_ethercat.program.arguments import Parser, seconds, whole
from bota_ethercat_bridge.rclpy_internals import taking
from bota_ethercat_bridge.subscription import Counted, report

_DISCOVERY_S: Final = 10.0


def main(arguments: Sequence[str] | None = None) -> int:
    program = (
        "check_subscription" if sys.argv[0].endswith("check_subscription") else "bridge-check-subscription"
    )
    parser = Parser(program, "What a subscriber loses here, and what to change.", "")
    parser.add_argument("topic", help="with stamps: wrench, imu/data_raw, ...")
    parser.add_argument("--depth", type=whole(1, 10**6), default=10, help="of the subscriber's QoS (10)")
    parser.add_argument("--best-effort", action="store_true", help="instead of reliable")
    parser.add_argument("--for", type=seconds, default=10.0, dest="seconds", metavar="SECONDS", help="(10)")
    given = parser.parse_args(remove_ros_args(["", *(sys.argv[1:] if arguments is None else arguments)])[1:])
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # RCLError, which has no public name
        parser.error(f"ROS cannot start: {str(error).partition(', at /')[0]}")
    node = rclpy.create_node("check_subscription", start_parameter_services=False)
    try:
        topic = node.resolve_topic_name(given.topic)
    except RuntimeError as error:  # rclpy has no public name for it
        parser.error(f"{given.topic!r} is no topic: {str(error).partition(', at /')[0]}")
    counted, publishers, is_stopped = Counted(topic), 0, True
    with contextlib.suppress(KeyboardInterrupt):  # what came until then is told
        if (publisher := _find(node, topic)) is not None:
            package, _, name = publisher.topic_type.split("/")
            kind = getattr(import_module(f"{package}.msg"), name)
            if not hasattr(kind, "header"):
                parser.error(
                    f"{topic} has no stamps ({publisher.topic_type}): name wrench, imu/data_raw, ..."
                )

            def receive(message: Any) -> None:
                counted.receive(message.header.stamp, time.time_ns())

            of_node = f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}/published"
            policy = ReliabilityPolicy.BEST_EFFORT if given.best_effort else ReliabilityPolicy.RELIABLE
            profile = QoSProfile(depth=given.depth, reliability=policy)
            take = taking(
                node,
                node.create_subscription(DiagnosticArray, of_node, counted.published, 10),
                node.create_subscription(kind, topic, receive, profile),
            )
            end_s = time.monotonic() + given.seconds
            while time.monotonic() < end_s:
                take(0.1)
            publishers = node.count_publishers(topic)
        is_stopped = False
    rclpy.try_shutdown()
    if not counted.received:
        why = "stopped" if is_stopped else f"nothing came on {topic}: see /diagnostics, ros2 topic info -v"
        sys.stderr.write(f"{program}: {why}\n")
        return 1
    if publishers > 1:
        sys.stdout.write(f"{topic} has {publishers} publishers, which falsifies the rest: stop all but one\n")
    for line in report(counted, given.depth, best_effort=given.best_effort):
        sys.stdout.write(f"{line}\n")
    return int(counted.lost > 0)


def _find(node: Node, topic: str) -> Any:
    """A publisher of the topic; None if there is none in time."""
    end_s = time.monotonic() + _DISCOVERY_S
    while time.monotonic() < end_s:
        time.sleep(0.1)
        for publisher in node.get_publishers_info_by_topic(topic):
            if "UNKNOWN" not in publisher.node_name:  # which becomes known later
                return publisher
    return None


if __name__ == "__main__":
    sys.exit(main())
