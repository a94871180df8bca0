"""`ethercat-replay`: the command line; catches signals while the rest is imported."""

from __future__ import annotations

import argparse
import ipaddress
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_clients.arguments import address
from bota_clients.program import Signals, start
from bota_ethercat.address import DEFAULT_HOST, Address
from bota_ethercat.program.arguments import Parser, number, typed
from bota_ethercat.program.output import ends_with_its_reader
from bota_ethercat.program.server_choice import own_server

_HOSTS: Final = ["127.0.0.1", "::1"]


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong. `speed` inf: as fast as clients read."""
    made = Parser(
        "ethercat-replay",
        "Serves a recording over the same protocol as ethercat-server.",
        "It starts with the first subscriber and ends as the server does. Ctrl-C ends it.",
        usage="%(prog)s [options] FILE",
    )
    add = made.add_argument
    add("path", type=Path, metavar="FILE", help="the recording")
    add("--server", type=address, metavar="HOST:PORT",
        help="serve at this address of this machine (default: as the clients' --server)")  # fmt: skip
    add("--speed", type=_speed, default=1.0, metavar="X",
        help="times the recorded speed; 'max': as fast as clients read, without loss")  # fmt: skip
    add("--loop", action="store_true", help="start again at the end, until Ctrl-C")
    options = made.parse_args(argv)
    try:
        server: Address = options.server or own_server()
        own = _HOSTS if server.host == DEFAULT_HOST else [_host(server.host)]
    except (ValueError, argparse.ArgumentTypeError) as error:
        made.error(str(error))
    options.port, options.hosts = server.port, own
    return options


def _speed(text: str) -> float:
    return math.inf if text == "max" else number(1e-6, 1e6, "'max' or a number")(text)


_host = typed(lambda text: str(ipaddress.ip_address(text)), "an IP address of this machine")


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    signals = Signals()
    return start("ethercat-replay", "replay.program", parse_options(argv), signals)
