"""The command line of `ethercat-monitor`."""

from __future__ import annotations

import argparse
import ipaddress
from collections.abc import Sequence
from typing import Final

from clients.arguments import add_imu_units, add_server, address, parser, seconds, server_of
from protocol.address import DEFAULT_HOST, Address
from protocol.pdo import ImuUnits

DEFAULT_WEB: Final = Address(DEFAULT_HOST, 12080)


class Options(argparse.Namespace):
    """What to show, and how."""

    address: Address
    once: bool
    json: bool
    seconds: float | None
    imu_units: ImuUnits
    ascii: bool
    web: Address | None


def parse(argv: Sequence[str] | None) -> Options:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = parser(
        "ethercat-monitor",
        "Shows the stream of ethercat-server live in the terminal. Press ? for the keys.",
        "With --once: exit code 0 if all is good or worth a look, 1 if there is trouble, or no server.",
    )
    add_server(made)
    add = made.add_argument
    add("old", nargs="?", help=argparse.SUPPRESS)  # HOST:PORT without --server
    add("--once", action="store_true", help="observe for a second, print a table and exit")
    add("--json", action="store_true", help="print one JSON object per second; with --once, just one")
    add("--seconds", type=seconds, metavar="S", help="exit after S seconds")
    add_imu_units(made)
    add("--ascii", action="store_true", help="use ASCII characters only")
    add(
        "--web", type=_loopback, nargs="?", const=DEFAULT_WEB, metavar="PORT",
        help=f"show it in a browser instead, on this port of this machine (default {DEFAULT_WEB.port})",
    )  # fmt: skip
    options = made.parse_args(argv, Options())
    options.address = server_of(made, options.server, options.old)
    if options.once and options.seconds is not None:
        made.error("--seconds cannot be combined with --once")
    if options.web is not None and (options.once or options.json):
        made.error("--web cannot be combined with --once or --json")
    return options


def is_loopback(host: str) -> bool:
    """Whether a host, without port, is this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _loopback(text: str) -> Address:
    where = address(text)
    if is_loopback(where.host):
        return where
    raise argparse.ArgumentTypeError(
        f"{text!r}: the page is for this machine only: give a port, and reach it from elsewhere over ssh -L"
    )
