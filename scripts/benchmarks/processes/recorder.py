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
from pathlib import Path
from typing import Final

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

    It waits for and takes messages itself, because rclpy's executor takes longer for that than everything
    else on the way: what is measured is to be the way to the subscriber, not the subscriber.
    """
    import rclpy  # noqa: PLC0415 - the arguments come first
    from geometry_msgs.msg import WrenchStamped  # noqa: PLC0415
    from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: PLC0415

    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    topics = [f"/benchmark_{position}" for position in range(int(sensors))]
    handles = [
        node.create_subscription(WrenchStamped, topic, lambda _: None, _DEPTH).handle for topic in topics
    ]
    with node.context.handle:
        wait_set = rclpy_implementation.WaitSet(len(handles), 0, 0, 0, 0, 0, node.context.handle)
    is_recording = True
    while is_recording:
        wait_set.clear_entities()
        for handle in handles:
            wait_set.add_subscription(handle)
        wait_set.wait(1_000_000_000)
        for position, handle in enumerate(handles):
            while is_recording and (taken := handle.take_message(WrenchStamped, False)) is not None:
                now = time.monotonic_ns()
                force, torque = taken[0].wrench.force, taken[0].wrench.torque
                clock = decode_clock((force.x, force.y, force.z, torque.x))
                is_recording = recording.add(position, *clock, 0, now)
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
