"""What a subcommand is, and the arguments that several have in common."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from ethercat_server.tool.link import Link
from ethercat_server.tool.reach import open_link

DONE: Final = 0
CHANGES: Final = 3
"""Exit code of `plan` when there is something to change."""


class Command(NamedTuple):
    """One subcommand."""

    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]
    """Returns the exit code; ServerError for what fails."""


def add_link_arguments(parser: argparse.ArgumentParser, *, all_if_none: bool = False) -> None:
    """IFACE or --server, and --sensor."""
    parser.add_argument(
        "iface", nargs="?", metavar="IFACE",
        help="interface the sensors are connected to ('virtual' for a virtual sensor); "
        "if a server holds it, that is used",
    )  # fmt: skip
    parser.add_argument("--server", metavar="HOST:PORT", help="go through this server instead of IFACE")
    default = "all" if all_if_none else "the only one"
    parser.add_argument(
        "--sensor",
        metavar="WHICH",
        help=f"place on the bus from 0, serial:1234, or name (default: {default})",
    )


@contextlib.contextmanager
def link(args: argparse.Namespace, *, any_slave: bool = False) -> Iterator[Link]:
    """The link that the arguments ask for (see `open_link`); closed at the end."""
    opened = open_link(args.iface, args.server, any_slave=any_slave)
    try:
        yield opened
    finally:
        opened.close()
