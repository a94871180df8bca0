"""A subcommand, and the arguments that subcommands share."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from ethercat_server.access.sensors import Sensors, open_sensors
from ethercat_server.ethercat.nic.interface import ALLOW_IP, ALLOW_IP_HELP
from protocol.program.server_choice import HELP

DONE: Final = 0
CHANGES: Final = 3
"""Exit code of `plan` when there is something to change."""


class Command(NamedTuple):
    """One subcommand."""

    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    """Returns the exit code; raises ServerError."""


def add_sensor_arguments(
    parser: argparse.ArgumentParser, *, all_if_none: bool = False, take_over: bool = True
) -> None:
    """IFACE or --server, and --sensor; `--force` to take over a bus in use, unless it has another meaning."""
    parser.add_argument(
        "iface", nargs="?", metavar="IFACE",
        help="interface the sensors are connected to ('virtual' for a virtual sensor); "
        "through the server that uses it, if there is one",
    )  # fmt: skip
    parser.add_argument(
        "--server", metavar="HOST:PORT", help=f"connect to this server, as without IFACE {HELP}"
    )
    if take_over:
        parser.add_argument(
            "--force", action="store_true", dest="take_over",
            help="take over a bus in use: slaves of others in SAFEOP or OP are taken to PREOP, machines stop",
        )  # fmt: skip
    parser.set_defaults(take_over=False)
    parser.add_argument(ALLOW_IP, action="store_true", help=ALLOW_IP_HELP)
    default = "all" if all_if_none else "the only one"
    parser.add_argument(
        "--sensor",
        metavar="WHICH",
        help=f"number on the bus from 0, serial:1234, or name (default: {default})",
    )


@contextlib.contextmanager
def sensors_of(args: argparse.Namespace) -> Iterator[Sensors]:
    """The sensors given by the arguments (see `open_sensors`); closed at the end."""
    found = open_sensors(args.iface, args.server, force=args.take_over, allow_ip=args.allow_ip)
    with contextlib.closing(found):
        yield found
