"""A TCP client of ethercat-server that notes when each sample arrives."""

from __future__ import annotations

import argparse
import gc
import socket
import time
from collections.abc import Callable

from ethercat_server.virtual_sensor.signals import decode_clock, decode_rest
from protocol.control import request
from protocol.framing import DataFlag, DataMessage, FrameDecoder, encode_json
from protocol.pdo import Sample, SampleDecoder
from scripts._benchmark_records import Recording, recording_arguments


def main() -> None:
    """Record, then end."""
    parser = argparse.ArgumentParser()
    recording_arguments(parser)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--signal", choices=("clock", "rest"), default="clock")
    arguments = parser.parse_args()
    recording = Recording(arguments.path, arguments.warm_up, arguments.seconds)
    gc.disable()
    with socket.create_connection(("127.0.0.1", arguments.port)) as connection:
        connection.sendall(encode_json(request("subscribe")))
        record(connection, recording, _number_at_rest if arguments.signal == "rest" else _clock)
        recording.write()


def _clock(sample: Sample) -> tuple[int, int]:
    return decode_clock(sample.array)


def _number_at_rest(sample: Sample) -> tuple[int, int]:
    """Its instant is not in the sample."""
    return decode_rest(sample.temperature), 0


def record(
    connection: socket.socket, recording: Recording, number_and_instant: Callable[[Sample], tuple[int, int]]
) -> None:
    """Note everything that comes until the time is over. The time is taken before anything is decoded."""
    decoder = FrameDecoder()
    decode = SampleDecoder(61).decode
    old = DataFlag.REPEATED | DataFlag.INVALID
    while data := connection.recv(65536):
        now = time.monotonic_ns()
        decoder.feed(data)
        for message in decoder:
            if not isinstance(message, DataMessage) or message.flags & old:
                continue
            clock = number_and_instant(decode(message.process_data))
            if not recording.take(message.sensor, *clock, message.monotonic_ns, now):
                return


if __name__ == "__main__":
    main()
