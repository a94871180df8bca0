"""The polling design, to compare with: exchange, send the raw bytes, sleep for a period; a client on a timer.

One sensor, one client; nothing is added but the figures that are written at the end.
"""

from __future__ import annotations

import argparse
import select
import signal
import socket
import struct
import time
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from scripts.benchmarks.records import Recording, connect, recording_arguments, write

TOPIC: Final = "/polling_sensor_data"
_SIZE: Final = 61
_VALUES: Final = struct.Struct("<5x6f2x3fx3f5x")


def server(arguments: argparse.Namespace) -> None:
    """Exchange, send, sleep; writes (wake-up lateness, exchange) pairs in ns on SIGTERM."""
    from scripts.benchmarks.processes.yardstick import operational_master  # noqa: PLC0415 - only the server needs it

    stopping: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopping.append(number))
    master = operational_master(arguments.ifname)
    period_s = 1 / arguments.rate
    timeout_us = int(period_s * 1e6)
    figures = array("q")
    with socket.create_server(("127.0.0.1", arguments.port)) as listener:
        client, _ = listener.accept()
    asleep = time.monotonic_ns()
    while not stopping:
        woke = time.monotonic_ns()
        select.select([client], [], [], 0)  # for a shutdown request
        sent = time.monotonic_ns()
        master.send_processdata()
        master.receive_processdata(timeout_us)
        figures.extend((woke - asleep - int(period_s * 1e9), time.monotonic_ns() - sent))
        try:
            client.sendall(master.slaves[0].input)
        except ConnectionError:
            break
        asleep = time.monotonic_ns()
        time.sleep(period_s)
    master.close()
    write(arguments.path, figures)


def poll(connection: socket.socket) -> bytes:
    """One message if there is one: what the client does at each tick of its timer."""
    if select.select([connection], [], [], 0)[0]:
        return connection.recv(_SIZE)
    return b""


def client(arguments: argparse.Namespace) -> None:
    """The client without ROS: a timer, and a poll at each tick."""
    recording = Recording(arguments.path, arguments.warm_up, arguments.seconds)
    period_ns = int(1e9 / arguments.rate)
    with connect(arguments.port) as connection:
        due = time.monotonic_ns()
        while True:
            due += period_ns
            now = time.monotonic_ns()
            if due > now:
                time.sleep((due - now) * 1e-9)
            else:
                due += (now - due) // period_ns * period_ns
            data = poll(connection)
            if len(data) == _SIZE:
                now = time.monotonic_ns()
                clock = decode_clock(_VALUES.unpack(data))
                if not recording.take(0, *clock, 0, now):
                    break
        recording.write()


def node(arguments: argparse.Namespace) -> None:
    """The client as a ROS 2 node: polls and publishes at each tick of a timer, until SIGTERM."""
    import rclpy  # noqa: PLC0415 - only the node needs it
    from rclpy.signals import SignalHandlerOptions  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    def stop(_number: int, _frame: object) -> None:
        raise SystemExit

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, stop)
    ros_node = rclpy.create_node("polling")
    publisher = ros_node.create_publisher(Float64MultiArray, TOPIC, 1)
    values: list[float] = []

    def tick() -> None:
        nonlocal values
        data = poll(connection)
        if len(data) == _SIZE:
            values = list(_VALUES.unpack(data))
        if values:
            message: Any = Float64MultiArray()
            message.data = values
            publisher.publish(message)

    with connect(arguments.port) as connection:
        ros_node.create_timer(1 / arguments.rate, tick)
        rclpy.spin(ros_node)


def main() -> None:
    """Run one of the three programs."""
    parser = argparse.ArgumentParser()
    programs = parser.add_subparsers(required=True)
    parts: tuple[Callable[[argparse.Namespace], None], ...] = (server, client, node)
    for part in parts:
        program = programs.add_parser(part.__name__)
        program.set_defaults(run=part)
        program.add_argument("--port", type=int, required=True)
        program.add_argument("--rate", type=float, required=True)
        if part is client:
            recording_arguments(program)
        elif part is server:
            program.add_argument("path", type=Path)
            program.add_argument("--ifname", required=True)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
