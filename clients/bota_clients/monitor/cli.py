"""`ethercat-monitor`: the command line. Exit codes: 0 fine, 1 not, 2 wrong usage."""

from __future__ import annotations

import argparse
import errno
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_clients.arguments import add_imu_units, add_server, address, is_loopback, server_of
from bota_clients.program import start
from bota_ethercat.address import DEFAULT_HOST, Address
from bota_ethercat.program.arguments import Parser, seconds
from bota_ethercat.program.output import discard_output, ends_with_its_reader

DEFAULT_WEB: Final = Address(DEFAULT_HOST, 12080)


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    try:
        return start("ethercat-monitor", "monitor.program", parse(argv))
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.EIO):  # the reader or the terminal was closed
            raise
        discard_output()
        return 0


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = Parser(
        "ethercat-monitor",
        "Shows the stream of ethercat-server live in the terminal. Press ? for the keys.",
        "With --once: exit code 0 if all is good or worth a look, 1 if there is trouble, or no server.",
    )
    add_server(made)
    add = made.add_argument
    add("--once", action="store_true",
        help="observe for a second, print a table and exit, as it does without a terminal")  # fmt: skip
    add("--json", action="store_true", help="print one JSON object per second; with --once, just one")
    add("--seconds", type=seconds, metavar="S", help="exit after S seconds")
    add("--tool", type=Path, metavar="YAML",
        help="show the wrench without this tool, too, and contact on its contact.surface (not with "
             "--web): parameters, as ethercat-identify --yaml writes them")  # fmt: skip
    add_imu_units(made)
    add(
        "--web", type=_loopback, nargs="?", const=DEFAULT_WEB, metavar="PORT",
        help=f"show it in a browser instead, on this port of this machine (default {DEFAULT_WEB.port})",
    )  # fmt: skip
    options = made.parse_args(argv)
    options.address = server_of(made, options.server)
    if options.once and options.seconds is not None:
        made.error("--seconds cannot be combined with --once")
    if options.web is not None and (options.once or options.json or options.tool):
        made.error("--web cannot be combined with --once, --json or --tool")
    return options


def _loopback(text: str) -> Address:
    where = address(text)
    if is_loopback(where.host):
        return where
    raise argparse.ArgumentTypeError(
        f"{text!r}: the page is for this machine only: give a port, and reach it from elsewhere over ssh -L"
    )


if __name__ == "__main__":
    sys.exit(main())
