"""The command line of `ethercat-replay`."""

from __future__ import annotations

import argparse
import ipaddress
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from clients.version import VERSION
from protocol.address import DEFAULT_PORT

_HOSTS: Final = ("127.0.0.1", "::1")
_SLOWEST: Final = 1e-6
_FASTEST: Final = 1e6


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What is to be played, and how."""

    paths: tuple[Path, ...]
    port: int
    hosts: tuple[str, ...]
    speed: float
    """1 = as recorded; infinite = as fast as the clients take it."""
    step: bool
    loop: bool
    original: bool
    at_once: bool
    control_users: tuple[str, ...]
    control_groups: tuple[str, ...]


def parse_options(argv: Sequence[str] | None) -> ReplayOptions:
    """Read the command line; argparse ends with exit code 2 for what is wrong."""
    parser = argparse.ArgumentParser(
        prog="ethercat-replay",
        usage="%(prog)s [options] FILE [FILE ...] [PORT]",
        description="Serves recordings over the same protocol as ethercat-server, one after the other.",
        epilog="It begins when the first client subscribes, and ends as a server does. Ctrl-C ends it.",
    )
    add = parser.add_argument
    add("arguments", nargs="+", metavar="FILE",
        help=f"recordings; a number behind them is the port (default {DEFAULT_PORT})")  # fmt: skip
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--speed", type=_speed, default=1.0, metavar="X",
        help="so many times as fast; 'max' is as fast as the clients take it, without a loss")  # fmt: skip
    pace.add_argument("--step", action="store_true",
        help="one frame for each line on standard input, N frames for the line N")  # fmt: skip
    add("--loop", action="store_true", help="begin again at the end, until Ctrl-C")
    add("--original-stamps", action="store_true", dest="original",
        help="numbers and stamps as they were recorded, not moved to now")  # fmt: skip
    add("--at-once", action="store_true", help="do not wait for the first client")
    add("--host", type=_host, action="append", dest="hosts", metavar="ADDRESS",
        help="address to listen on; may be given more than once (default 127.0.0.1 and ::1)")  # fmt: skip
    add("--control-user", action="append", default=[], metavar="NAME",
        help="user who may shut it down, beside root and its own user")  # fmt: skip
    add("--control-group", action="append", default=[], metavar="NAME", help="group whose members may")
    add("--version", action="version", version=f"%(prog)s {VERSION}")
    given = parser.parse_intermixed_args(argv)
    names: list[str] = given.arguments
    port = DEFAULT_PORT
    if len(names) > 1 and names[-1].isascii() and names[-1].isdecimal():
        port = int(names.pop())
        if not 1 <= port <= 65535:
            parser.error(f"port {port} is out of range: it must be from 1 to 65535")
    return ReplayOptions(
        tuple(map(Path, names)), port, tuple(given.hosts or _HOSTS), given.speed, given.step, given.loop,
        given.original, given.at_once, tuple(given.control_user), tuple(given.control_group),
    )  # fmt: skip


def _speed(text: str) -> float:
    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if _SLOWEST <= speed <= _FASTEST:
        return speed
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a number, such as 2 or 0.5, or 'max'")


def _host(text: str) -> str:
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: it must be an IP address of this machine") from None
