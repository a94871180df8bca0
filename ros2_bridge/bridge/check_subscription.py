# SPDX-License-Identifier: Apache-2.0
"""`ros2 run bota_ethercat_bridge check_subscription`: what a plain rclpy subscriber of a topic loses on this
machine, how old its messages are, and what to change.

Exit codes: 0 nothing lost, 1 something lost or nothing received, 2 wrong arguments.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any, Final

from bridge.subscription import Subscription

_DISCOVERY_S: Final = 10.0
_CONTROL_MS: Final = 5.0  # older samples are no good to a control loop
_DEEP: Final = 100  # that much is enough for pauses of this machine, but not for a slow callback


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("check_subscription", description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("topic", help="of the node, with a header: wrench, imu/data_raw, ...")
    parser.add_argument("--depth", type=int, default=10, help="of the subscriber's QoS (10)")
    parser.add_argument("--best-effort", action="store_true", help="instead of reliable")
    parser.add_argument("--for", type=float, default=10.0, dest="seconds", metavar="SECONDS", help="(10)")
    import rclpy  # noqa: PLC0415 - --help needs no ROS

    own = rclpy.utilities.remove_ros_args(["", *(sys.argv[1:] if arguments is None else arguments)])[1:]
    given = parser.parse_args(own)
    if given.depth < 1 or given.seconds <= 0:
        parser.error("--depth must be 1 or more, --for more than 0")
    rclpy.init(args=arguments)
    try:
        return _measure(given)
    finally:
        rclpy.try_shutdown()


def _measure(given: argparse.Namespace) -> int:
    import rclpy  # noqa: PLC0415
    from diagnostic_msgs.msg import DiagnosticArray  # noqa: PLC0415
    from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415
    from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: PLC0415

    node = rclpy.create_node("check_subscription")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    topic, end_s = node.resolve_topic_name(given.topic), time.monotonic() + _DISCOVERY_S
    while not (publishers := node.get_publishers_info_by_topic(topic)):
        if time.monotonic() > end_s:
            sys.stderr.write(
                f"check_subscription: nobody publishes {topic}: start the node, or see ros2 topic list\n"
            )
            return 1
        executor.spin_once(0.1)
    package, _, kind = publishers[0].topic_type.split("/")
    message_type = getattr(import_module(f"{package}.msg"), kind)
    if "header" not in message_type.get_fields_and_field_types():
        sys.stderr.write(f"check_subscription: {topic} has no stamps: give another topic, such as wrench\n")
        return 2
    policy = ReliabilityPolicy.BEST_EFFORT if given.best_effort else ReliabilityPolicy.RELIABLE
    of_node = f"{publishers[0].node_namespace.rstrip('/')}/{publishers[0].node_name}/published"
    subscription, ages_ns = Subscription(topic), list[int]()

    def receive(message: Any) -> None:
        subscription.receive(message.header.stamp, time.time_ns())
        ages_ns.append(subscription.age_ns)

    node.create_subscription(DiagnosticArray, of_node, subscription.published, 10)
    node.create_subscription(message_type, topic, receive, QoSProfile(depth=given.depth, reliability=policy))
    end_s = time.monotonic() + given.seconds
    while time.monotonic() < end_s:
        executor.spin_once(0.1)
    for line in report(subscription, ages_ns, given.depth, best_effort=given.best_effort):
        sys.stdout.write(f"{line}\n")
    return 1 if subscription.lost or not ages_ns else 0


def report(counted: Subscription, ages_ns: Sequence[int], depth: int, *, best_effort: bool) -> Iterator[str]:
    """What was measured, and what to change: a sentence each."""
    if not ages_ns:
        yield "nothing received: see whether the node has samples (/diagnostics) and this QoS is compatible"
        return
    ordered = sorted(ages_ns)
    p50, p99, longest = (ordered[min(len(ordered) * n // 100, len(ordered) - 1)] / 1e6 for n in (50, 99, 100))
    yield f"received {counted.received}, lost {counted.lost}, missing {counted.missing}"
    yield f"age p50 {p50:.1f} ms, p99 {p99:.1f} ms, longest {longest:.1f} ms"
    if not counted.rate_hz:
        yield "lost is not known: the node that publishes has no ~/published"
    waiting_ms = 500 * depth / counted.rate_hz if counted.rate_hz else 0.0  # half of the queue
    if counted.lost and best_effort:
        yield "lost by best effort: subscribe reliably"
    elif counted.lost and depth < _DEEP:
        yield f"the queue was too short for a pause of this process: raise the depth to {_DEEP}"
    elif counted.lost and p50 > waiting_ms:
        yield "the queue is always full: use an executor for this topic alone, C++, or publishing_frequency"
    elif counted.lost:
        yield "long pauses: raise the depth, or give this process real-time priority (docs/tuning.md)"
    if p99 > _CONTROL_MS:
        yield "too old for a control loop: real-time priority (docs/tuning.md), or ros2_control's plugin"
    if counted.missing > counted.lost:
        yield f"{counted.missing - counted.lost} samples were not published: see the node's /diagnostics"


if __name__ == "__main__":
    sys.exit(main())
