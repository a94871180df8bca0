"""The polling design, to compare with: exchange, send the raw bytes, sleep for a period; a node on a timer.

One sensor, one client; nothing is added but the figures that are written at the end.
"""

from __future__ import annotations

import argparse
import select
import signal
import socket
import time
from array import array
from pathlib import Path
from typing import Any, Final

from protocol.pdo import SampleDecoder
from scripts.benchmarks.processes.recorder import SIZE, poll
from scripts.benchmarks.records import connect, write

TOPIC: Final = "/polling_sensor_data"


def server(arguments: argparse.Namespace) -> None:
    """Exchange, send, sleep; writes (wake-up lateness, exchange) pairs in ns on SIGTERM."""
    from scripts.benchmarks.processes.yardstick import operational_master  # noqa: PLC0415 - only the server needs it

    stopping: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopping.append(number))
    master = operational_master(arguments.ifname)
    period_s = 1 / arguments.rate
    figures = array("q")
    with socket.create_server(("127.0.0.1", arguments.port)) as listener:
        client, _ = listener.accept()
    asleep = time.monotonic_ns()
    while not stopping:
        woke = time.monotonic_ns()
        select.select([client], [], [], 0)  # for a shutdown request
        sent = time.monotonic_ns()
        master.send_processdata()
        master.receive_processdata(int(period_s * 1e6))
        figures.extend((woke - asleep - int(period_s * 1e9), time.monotonic_ns() - sent))
        try:
            client.sendall(master.slaves[0].input)
        except ConnectionError:
            break
        asleep = time.monotonic_ns()
        time.sleep(period_s)
    master.close()
    write(arguments.path, figures)


def node(arguments: argparse.Namespace) -> None:
    """A ROS 2 node: polls and publishes at each tick of a timer, until SIGTERM."""
    import rclpy  # noqa: PLC0415 - only the node needs it
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    def stop(_number: int, _frame: object) -> None:
        raise SystemExit

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, stop)
    ros_node = rclpy.create_node("polling")
    publisher = ros_node.create_publisher(Float64MultiArray, TOPIC, 1)
    message: Any = Float64MultiArray()
    decode = SampleDecoder(SIZE).decode

    def tick() -> None:
        data = poll(connection)
        if len(data) == SIZE:
            message.data = decode(data).array
        if message.data:
            publisher.publish(message)

    with connect(arguments.port) as connection:
        ros_node.create_timer(1 / arguments.rate, tick)
        rclpy.spin(ros_node)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=("server", "node"))
    parser.add_argument("path", type=Path)
    parser.add_argument("--ifname")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--rate", type=float, required=True)
    given = parser.parse_args()
    {"server": server, "node": node}[given.part](given)
