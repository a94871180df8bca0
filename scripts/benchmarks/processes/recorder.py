"""Records when each sample arrives: at a TCP client, or at a ROS 2 subscriber.

Both note the time before anything is decoded.

Arguments: KIND FILE WARM_UP_S SECONDS PRIORITY, then of `ros` the number of sensors.
"""

from __future__ import annotations

import gc
import socket
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client import make_real_time
from bota_ethercat.control import request
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from bota_ethercat.pdo import SampleDecoder
from scripts.benchmarks.records import INPUT_BYTES, PORT, ArrivalRecorder, decode_clock

_DEPTH: Final = 50


def tcp(recording: ArrivalRecorder, port: int = PORT) -> None:
    frames, decode = FrameDecoder(), SampleDecoder(INPUT_BYTES).decode
    old = DataFlag.REPEATED | DataFlag.INVALID
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(encode_json(request("subscribe")))
        while size := connection.recv_into(frames.get_buffer()):
            now = time.monotonic_ns()
            frames.received(size)
            for frame in frames:
                if not isinstance(frame, DataMessage) or frame.flags & old:
                    continue
                clock = decode_clock(decode(frame.process_data).array)
                if not recording.add(frame.sensor, *clock, frame.monotonic_ns, now):
                    return


def ros(recording: ArrivalRecorder, sensors: str) -> None:
    """A subscriber of the `wrench` of each sensor.

    What is measured is to be the way to the subscriber, not the subscriber.
    """
    import rclpy  # noqa: PLC0415 - the arguments come first
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415

    from bota_ethercat_bridge.rclpy_internals import taking  # noqa: PLC0415

    is_recording = True

    def add(position: int, message: Any) -> None:
        nonlocal is_recording
        now, force, torque = time.monotonic_ns(), message.wrench.force, message.wrench.torque
        clock = decode_clock((force.x, force.y, force.z, torque.x))
        is_recording = is_recording and recording.add(position, *clock, 0, now)

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    take = taking(node, *(
        node.create_subscription(WrenchStamped, f"/benchmark_{position}", partial(add, position), _DEPTH)
        for position in range(int(sensors))
    ))  # fmt: skip
    while is_recording:
        take(1.0)
    node.destroy_node()
    rclpy.try_shutdown()


KINDS: Final[dict[str, Callable[..., None]]] = {"tcp": tcp, "ros": ros}


def main(kind: str, path: str, warm_up_s: str, seconds: str, priority: str, *arguments: str) -> None:
    recording = ArrivalRecorder(Path(path), float(warm_up_s), float(seconds))
    gc.disable()
    make_real_time(int(priority))  # of all threads: the middleware's inherit it
    KINDS[kind](recording, *arguments)
    recording.write()


if __name__ == "__main__":
    main(*sys.argv[1:])
