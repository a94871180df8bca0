"""Records when each sample arrives: at a TCP client, at a ROS 2 subscriber, or at a client that polls.

All of them note the time before anything is decoded.
"""

from __future__ import annotations

import argparse
import gc
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client import make_real_time
from bota_ethercat.control import request
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from bota_ethercat.pdo import SampleDecoder
from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from scripts.benchmarks.records import PORT, Recording, connect, sleep_until

SIZE: Final = 61
_DEPTH: Final = 50


def tcp(arguments: argparse.Namespace, recording: Recording) -> None:
    """A client of ethercat-server."""
    frames, decode = FrameDecoder(), SampleDecoder(SIZE).decode
    old = DataFlag.REPEATED | DataFlag.INVALID
    with connect(arguments.port) as connection:
        connection.sendall(encode_json(request("subscribe")))
        while data := connection.recv(65536):
            now = time.monotonic_ns()
            frames.feed(data)
            for frame in frames:
                if not isinstance(frame, DataMessage) or frame.flags & old:
                    continue
                clock = decode_clock(decode(frame.process_data).array)
                if not recording.take(frame.sensor, *clock, frame.monotonic_ns, now):
                    return


def polling(arguments: argparse.Namespace, recording: Recording) -> None:
    """A timer, and a look for one message at each tick."""
    period_ns, decode = int(1e9 / arguments.rate), SampleDecoder(SIZE).decode
    with connect(arguments.port) as connection:
        due = now = time.monotonic_ns()
        while True:
            due += period_ns * max(1, (now - due) // period_ns)
            sleep_until(due)
            data = connection.recv(SIZE) if select.select([connection], [], [], 0)[0] else b""
            now = time.monotonic_ns()
            if len(data) == SIZE and not recording.take(0, *decode_clock(decode(data).array), 0, now):
                return


def ros(arguments: argparse.Namespace, recording: Recording) -> None:
    """A subscriber: of `wrench`, or of arrays.

    It waits for and takes messages itself, because rclpy's executor takes longer for that than everything
    else on the way: what is measured is to be the way to the subscriber, not the subscriber.
    """
    import rclpy  # noqa: PLC0415 - the arguments come first
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415
    from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: PLC0415
    from std_msgs.msg import Float64MultiArray  # noqa: PLC0415

    def wrench(message: Any) -> tuple[float, ...]:
        force, torque = message.wrench.force, message.wrench.torque
        return force.x, force.y, force.z, torque.x

    kinds: list[tuple[Any, str, Callable[[Any], Any]]]
    kinds = [(Float64MultiArray, topic, lambda message: message.data) for topic in arguments.arrays]
    kinds = kinds or [(WrenchStamped, "wrench", wrench)]
    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    handles = [
        node.create_subscription(kind, topic, lambda _message: None, _DEPTH).handle
        for kind, topic, _ in kinds
    ]
    with node.context.handle:
        wait_set = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    goes_on = True
    while goes_on:
        wait_set.clear_entities()
        for handle in handles:
            wait_set.add_subscription(handle)
        wait_set.wait(1_000_000_000)
        for position, (handle, (kind, _, values)) in enumerate(zip(handles, kinds, strict=True)):
            while goes_on and (taken := handle.take_message(kind, False)) is not None:
                now = time.monotonic_ns()
                goes_on = recording.take(position, *decode_clock(values(taken[0])), 0, now)
    node.destroy_node()
    rclpy.try_shutdown()


def main() -> None:
    """Record, then end."""
    parser = argparse.ArgumentParser()
    kinds = {"tcp": tcp, "polling": polling, "ros": ros}
    parser.add_argument("kind", choices=kinds)
    parser.add_argument("path", type=Path)
    parser.add_argument("warm_up", type=float)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--port", type=int, default=PORT)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--rt-priority", type=int, default=0, help="of all its threads")
    parser.add_argument("--arrays", nargs="*", default=(), help="topics of arrays; the sensors' positions")
    arguments = parser.parse_args()
    recording = Recording(arguments.path, arguments.warm_up, arguments.seconds)
    gc.disable()
    make_real_time(arguments.rt_priority)  # the middleware's threads inherit it
    kinds[arguments.kind](arguments, recording)
    recording.write()


if __name__ == "__main__":
    main()
