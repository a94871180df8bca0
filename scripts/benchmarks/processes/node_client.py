"""Notes when each sample arrives: at a TCP client, or at a ROS 2 subscriber of `wrench`.

Four whole numbers an arrival: the sample's `stamp_ns`, its `monotonic_ns` (0: ROS messages have none), a
check sum of force and torque, CLOCK_MONOTONIC of the arrival.
`newest` is `wrench` with a queue of one, so that nothing waits here; `all` subscribes to every topic
of the node's, to give it work.
"""

from __future__ import annotations

import argparse
import gc
import signal
import struct
import time
import zlib
from array import array
from pathlib import Path
from typing import Any

from protocol.client import Client
from scripts.benchmarks.processes.subscriber import messages
from scripts.benchmarks.records import began, write

COLUMNS = 4
_DEPTH = 50
_WRENCH = struct.Struct("<6d")


def check_sum(force: Any, torque: Any) -> int:
    """Of the six numbers as they are, to the bit."""
    return zlib.crc32(_WRENCH.pack(*force, *torque))


def tcp(port: int, note: Any) -> None:
    """Every new and valid sample of the server's, until it ends the connection."""
    with Client(port, reconnect=False).connect() as sensor:
        for frame in sensor.frames():
            now = time.monotonic_ns()
            sample = sensor.decode(frame)
            note((frame.stamp_ns, frame.monotonic_ns, check_sum(sample.force, sample.torque), now))


def ros(note: Any, depth: int) -> None:
    """Every message of the topic `wrench`, until the process is ended."""
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415 - the arguments come first

    for _, message, now in messages(WrenchStamped, ["wrench"], depth):
        stamp, force, torque = message.header.stamp, message.wrench.force, message.wrench.torque
        values = check_sum((force.x, force.y, force.z), (torque.x, torque.y, torque.z))
        note((stamp.sec * 1_000_000_000 + stamp.nanosec, 0, values, now))


def every_topic(note: Any) -> None:
    """Subscribe to every topic of the node's, with rclpy's executor, until the process is ended."""
    import rclpy  # noqa: PLC0415 - the arguments come first
    from diagnostic_msgs.msg import DiagnosticArray  # noqa: PLC0415
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415
    from sensor_msgs.msg import Imu, Temperature  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    def on_message(_message: Any) -> None:
        note((0, 0, 0, time.monotonic_ns()))

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    topics = (
        (WrenchStamped, "wrench"), (Float64MultiArray, "/sensone_sensor_data"), (Imu, "imu/data_raw"),
        (Temperature, "temperature"), (DiagnosticArray, "/diagnostics"),
    )  # fmt: skip
    for kind, topic in topics:
        node.create_subscription(kind, topic, on_message, _DEPTH)
    rclpy.spin(node)


def main() -> None:
    """Record until SIGTERM, then write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("tcp", "wrench", "newest", "all"))
    parser.add_argument("path", type=Path)
    parser.add_argument("--port", type=int, required=True)
    arguments = parser.parse_args()
    values = array("q")
    first = began(arguments.path)

    def note(row: tuple[int, int, int, int]) -> None:
        if not values:
            first.touch()
        values.extend(row)

    def stop(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    gc.disable()
    try:
        if arguments.what == "tcp":
            tcp(arguments.port, note)
        elif arguments.what == "all":
            every_topic(note)
        else:
            ros(note, 1 if arguments.what == "newest" else _DEPTH)
    except KeyboardInterrupt:
        pass
    finally:
        write(arguments.path, values)


if __name__ == "__main__":
    main()
