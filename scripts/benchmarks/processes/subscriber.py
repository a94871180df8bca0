"""A ROS 2 subscriber that notes when each sample arrives; its topics are the sensors', by position.

It waits for and takes messages itself, because rclpy's executor takes longer for that than everything else on
the way: what is measured is to be the way to the subscriber, not the subscriber.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Iterator, Sequence
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
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415 - the arguments come first
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    def values(message: Any) -> Sequence[float]:
        if not wrench:
            return cast(Sequence[float], message.data)
        force, torque = message.wrench.force, message.wrench.torque
        return force.x, force.y, force.z, torque.x

    for position, message, now in messages(WrenchStamped if wrench else Float64MultiArray, topics):
        if not recording.take(position, *decode_clock(values(message)), 0, now):
            return


def messages(kind: Any, topics: Sequence[str], depth: int = _DEPTH) -> Iterator[tuple[int, Any, int]]:
    """Subscribe; position of its topic, message, and when it was taken, for each that comes."""
    import rclpy  # noqa: PLC0415 - the arguments come first
    from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: PLC0415

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    handles = [node.create_subscription(kind, topic, lambda _message: None, depth).handle for topic in topics]
    try:
        with node.context.handle:
            wait_set = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
        while True:
            wait_set.clear_entities()
            for handle in handles:
                wait_set.add_subscription(handle)
            wait_set.wait(1_000_000_000)
            for position, handle in enumerate(handles):
                while (taken := handle.take_message(kind, False)) is not None:
                    yield position, taken[0], time.monotonic_ns()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
