"""A ROS 2 subscriber that notes when each sample arrives; its topics are the sensors', by position.

It waits for and takes messages itself, because rclpy's executor takes longer for that than everything else on
the way: what is measured is to be the way to the subscriber, not the subscriber.
"""

from __future__ import annotations

import argparse
import gc
import time
from typing import Final

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from scripts.benchmarks.records import Recording, recording_arguments

_DEPTH: Final = 50


def main() -> None:
    """Record, then end."""
    parser = argparse.ArgumentParser()
    recording_arguments(parser)
    parser.add_argument("topics", nargs="+")
    arguments = parser.parse_args()
    recording = Recording(arguments.path, arguments.warm_up, arguments.seconds)
    gc.disable()
    receive(arguments.topics, recording)
    recording.write()


def receive(topics: list[str], recording: Recording) -> None:
    """Note every message that comes until the time is over."""
    import rclpy  # noqa: PLC0415 - the arguments come first
    from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    handles = [
        node.create_subscription(Float64MultiArray, topic, lambda _message: None, _DEPTH).handle
        for topic in topics
    ]
    with node.context.handle:
        wait_set = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    going_on = True
    while going_on:
        wait_set.clear_entities()
        for handle in handles:
            wait_set.add_subscription(handle)
        wait_set.wait(1_000_000_000)
        for position, handle in enumerate(handles):
            while (taken := handle.take_message(Float64MultiArray, False)) is not None:
                now = time.monotonic_ns()
                going_on = recording.take(position, *decode_clock(taken[0].data), 0, now)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
