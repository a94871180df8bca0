"""The command line of `ethercat-record`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_clients.arguments import (
    add_force,
    add_server,
    file_and_server,
    number,
    parser,
    position,
    seconds,
    server_of,
)
from bota_ethercat.address import Address

_UNITS: Final = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9}
_SIZE: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)([kMG]?)B?", re.ASCII)
_LEAST_SIZE: Final = 100_000
_TIMES: Final = {"": 1, "s": 1, "min": 60, "h": 3600}
_TIME: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?(s|min|h|)", re.ASCII)
_LONGEST_S: Final = 1e9


class RecordOptions(argparse.Namespace):
    """What to record, and where."""

    path: Path
    address: Address
    sensors: list[int] | None
    """Positions on the bus, ascending; None for all."""
    seconds: float | None
    rotate_size: int | None
    rotate_seconds: float | None
    force: bool
    wait: bool
    reconnect: bool
    until_eof: bool


def parse_options(argv: Sequence[str] | None) -> RecordOptions:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = parser(
        "ethercat-record",
        "Records the unmodified stream of ethercat-server into an MCAP file.",
        "Ctrl-C ends the recording. SIZE is in bytes, or such as 500k, 100M, 2G.",
        usage="%(prog)s [options] OUT.mcap",
    )
    add = made.add_argument
    add("names", nargs="+", metavar="OUT.mcap", help="file to write")
    add_server(made)
    add("--sensor", type=position, action="append", dest="sensors", metavar="N",
        help="record only the sensor at this position on the bus; repeatable")  # fmt: skip
    add("--for", type=_duration, dest="seconds", metavar="TIME", help="stop after this time: 30s, 5min, 2h")
    add("--seconds", type=seconds, metavar="S", help="the same in seconds")
    add("--rotate-size", type=_size, metavar="SIZE", help="start a new file when one reaches this size")
    add("--rotate-seconds", type=number(1, 1e9, "at least 1 s"), metavar="S",
        help="start a new file every S seconds")  # fmt: skip
    add_force(made)
    add("--wait", action="store_true", help="wait for the server to start")
    add("--no-reconnect", action="store_false", dest="reconnect",
        help="stop when the connection ends, instead of reconnecting")  # fmt: skip
    add("--until-eof", action="store_true",
        help="stop at the end of standard input, when the program at its other end exits")  # fmt: skip
    options = made.parse_intermixed_args(argv, RecordOptions())
    options.path, old = file_and_server(made, options.names)
    options.address = server_of(made, options.server, old)
    if options.sensors is not None:
        options.sensors = sorted(set(options.sensors))
    return options


def _duration(text: str) -> float:
    """Seconds."""
    match = _TIME.fullmatch(text)
    found = float(match[1]) * _TIMES[match[2]] if match else 0.0
    if 0 < found <= _LONGEST_S:
        return found
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a time such as 30s, 5min or 2h")


def _size(text: str) -> int:
    match = _SIZE.fullmatch(text)
    size = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if size >= _LEAST_SIZE:
        return size
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a size such as 100M, at least 100k")
