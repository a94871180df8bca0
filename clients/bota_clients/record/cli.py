"""`ethercat-record`: the command line; catches signals while the rest is imported."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from bota_clients.arguments import add_force, add_server, number, parser, position, seconds, server_of, typed
from bota_clients.program import Signals, start
from bota_ethercat.address import Address
from bota_ethercat.program.server_choice import is_address


class RecordOptions(argparse.Namespace):
    """What to record, and where."""

    path: Path
    address: Address
    sensors: list[int] | None  # positions on the bus, ascending; None for all
    seconds: float | None
    rotate_size: float | None  # bytes
    rotate_seconds: float | None
    force: bool
    wait: bool
    reconnect: bool
    until_eof: bool


def _scaled(
    form: str, units: Mapping[str, int], low: float, high: float, what: str
) -> Callable[[str], float]:
    """The type of an argument that is a number with a unit."""

    def convert(text: str) -> float:
        match = re.fullmatch(form, text, re.ASCII)
        if match and low <= (value := float(match[1]) * units[match[2]]) <= high:
            return value
        raise ValueError

    return typed(convert, what)


_duration = _scaled(
    r"([0-9]+(?:\.[0-9]+)?) ?(s|min|h|)", {"": 1, "s": 1, "min": 60, "h": 3600},
    1e-9, 1e9, "a time such as 30s, 5min or 2h",
)  # fmt: skip
_size = _scaled(
    r"([0-9]+(?:\.[0-9]+)?)([kMG]?)B?", {"": 1, "k": 10**3, "M": 10**6, "G": 10**9},
    100_000, math.inf, "a size such as 100M, at least 100k",
)  # fmt: skip


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
    # The file, and the address in its old form, in either order.
    names: list[str] = options.names
    name, *others = [*sorted(names[:2], key=is_address), *names[2:]]
    if is_address(name):
        made.error(
            f"{name} is a server's address, no file: write FILE.mcap --server {name}, "
            f"or ./{name} if a file is called so"
        )
    if len(others) > 1:
        made.error(f"unexpected argument {others[1]!r}")
    options.path, options.address = Path(name), server_of(made, options.server, *others)
    if options.sensors is not None:
        options.sensors = sorted(set(options.sensors))
    return options


def main(argv: Sequence[str] | None = None) -> int:
    """Record; returns the exit code."""
    signals = Signals()
    return start("ethercat-record", "record.program", parse_options(argv), signals)


if __name__ == "__main__":
    sys.exit(main())
