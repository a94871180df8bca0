"""Records when each sample arrives: at a TCP client, or at a ROS 2 subscriber.

Both note the time before anything is decoded.

Arguments: KIND FILE WARM_UP_S SECONDS PRIORITY, then of `ros` the topics of arrays.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client import make_real_time
from bota_ethercat.control import request
from bota_ethercat.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from bota_ethercat.pdo import SampleDecoder
from ethercat_server.virtual_sensor.signals import decode_clock
from scripts.benchmarks.records import PORT, Recording, connect

SIZE: Final = 61
_DEPTH: Final = 50


def tcp(recording: Recording, port: int = PORT) -> None:
    """A client of ethercat-server."""
    frames, decode = FrameDecoder(), SampleDecoder(SIZE).decode
    old = DataFlag.REPEATED | DataFlag.INVALID
    with connect(port) as connection:
        connection.sendall(encode_json(request("subscribe")))
        while size := connection.recv_into(frames.get_buffer()):
            now = time.monotonic_ns()
            frames.received(size)
            for frame in frames:
                if not isinstance(frame, DataMessage) or frame.flags & old:
                    continue
                clock = decode_clock(decode(frame.process_data).array)
                if not recording.take(frame.sensor, *clock, frame.monotonic_ns, now):
                    return


def ros(recording: Recording, *topics: str) -> None:
    """A subscriber: of arrays, by the sensors' positions, or of `wrench`.

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
    kinds = [(Float64MultiArray, topic, lambda message: message.data) for topic in topics]
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


KINDS: Final[dict[str, Callable[..., None]]] = {"tcp": tcp, "ros": ros}


def main(kind: str, path: str, warm_up_s: str, seconds: str, priority: str, *arguments: str) -> None:
    """Record, then end."""
    recording = Recording(Path(path), float(warm_up_s), float(seconds))
    gc.disable()
    make_real_time(int(priority))  # of all threads: the middleware's inherit it
    KINDS[kind](recording, *arguments)
    recording.write()


if __name__ == "__main__":
    main(*sys.argv[1:])
