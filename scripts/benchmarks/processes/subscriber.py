"""A ROS 2 subscriber that notes when each sample arrives; its topics are the sensors', by position.

It waits for and takes messages itself, because rclpy's executor takes longer for that than everything else on
the way: what is measured is to be the way to the subscriber, not the subscriber.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Sequence
from typing import Any, Final, cast

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from protocol.client import make_real_time
from scripts.benchmarks.records import Recording, recording_arguments

_DEPTH: Final = 50


def main() -> None:
    """Record, then end."""
    parser = argparse.ArgumentParser()
    recording_arguments(parser)
    parser.add_argument("--rt-priority", type=int, default=0, help="of all its threads")
    parser.add_argument("--wrench", action="store_true", help="the topics are WrenchStamped")
    parser.add_argument("topics", nargs="+")
    arguments = parser.parse_args()
    recording = Recording(arguments.path, arguments.warm_up, arguments.seconds)
    gc.disable()
    make_real_time(arguments.rt_priority)  # the middleware's threads inherit it
    receive(arguments.topics, recording, wrench=arguments.wrench)
    recording.write()


def receive(topics: list[str], recording: Recording, *, wrench: bool = False) -> None:
    """Note every message that comes until the time is over."""
    import rclpy  # noqa: PLC0415 - the arguments come first
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415
    from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    def values(message: Any) -> Sequence[float]:
        if not wrench:
            return cast(Sequence[float], message.data)
        force, torque = message.wrench.force, message.wrench.torque
        return force.x, force.y, force.z, torque.x

    kind = WrenchStamped if wrench else Float64MultiArray
    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    handles = [
        node.create_subscription(kind, topic, lambda _message: None, _DEPTH).handle for topic in topics
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
            while (taken := handle.take_message(kind, False)) is not None:
                now = time.monotonic_ns()
                going_on = recording.take(position, *decode_clock(values(taken[0])), 0, now)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
