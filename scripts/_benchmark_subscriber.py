"""A ROS 2 subscriber that notes when each sample arrives; its topics are the sensors', by place."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from ethercat_server.virtual_sensor.signals import decode_clock
from scripts._benchmark_records import Recording, recording_arguments


def main() -> None:
    """Record, then end."""
    import rclpy  # noqa: PLC0415 - the arguments come first
    from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    parser = argparse.ArgumentParser()
    recording_arguments(parser)
    parser.add_argument("topics", nargs="+")
    arguments = parser.parse_args()
    path: Path = arguments.path
    recording = Recording(path, arguments.warm_up, arguments.seconds)
    going_on = True

    def listen(place: int, topic: str) -> None:
        def on_message(message: Any) -> None:
            nonlocal going_on
            now = time.monotonic_ns()
            clock = decode_clock(message.data)
            going_on = recording.take(place, *clock, 0, now)

        node.create_subscription(Float64MultiArray, topic, on_message, 10)

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    for place, topic in enumerate(arguments.topics):
        listen(place, topic)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while going_on:
        executor.spin_once(timeout_sec=1.0)
    recording.write()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
