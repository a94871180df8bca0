"""A TCP client of ethercat-server that records when each sample arrives."""

from __future__ import annotations

import argparse
import gc
import socket
import time

from ethercat_server.virtual_sensor.measurement.signals import decode_clock
from protocol.client import make_real_time
from protocol.control import request
from protocol.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from protocol.pdo import SampleDecoder
from scripts.benchmarks.records import Recording, recording_arguments


def main() -> None:
    """Record, then end."""
    parser = argparse.ArgumentParser()
    recording_arguments(parser)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--rt-priority", type=int, default=0)
    arguments = parser.parse_args()
    recording = Recording(arguments.path, arguments.warm_up, arguments.seconds)
    gc.disable()
    make_real_time(arguments.rt_priority)
    with socket.create_connection(("127.0.0.1", arguments.port)) as connection:
        connection.sendall(encode_json(request("subscribe")))
        record(connection, recording)
        recording.write()


def record(connection: socket.socket, recording: Recording) -> None:
    """Record what arrives until the time is over. The time is taken before anything is decoded."""
    decoder = FrameDecoder()
    decode = SampleDecoder(61).decode
    old = DataFlag.REPEATED | DataFlag.INVALID
    while data := connection.recv(65536):
        now = time.monotonic_ns()
        decoder.feed(data)
        for message in decoder:
            if not isinstance(message, DataMessage) or message.flags & old:
                continue
            clock = decode_clock(decode(message.process_data).array)
            if not recording.take(message.sensor, *clock, message.monotonic_ns, now):
                return


if __name__ == "__main__":
    main()
