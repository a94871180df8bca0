"""The command line of `ethercat-monitor`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

from clients.arguments import add_address, add_imu_units, seconds
from clients.version import VERSION
from protocol.address import Address
from protocol.pdo import ImuUnits


@dataclass(frozen=True, slots=True)
class Options:
    """What was asked for."""

    address: Address
    once: bool
    json: bool
    seconds: float | None
    imu_units: ImuUnits
    ascii: bool


def parse(argv: Sequence[str] | None) -> Options:
    """The options in `argv`; SystemExit with 2 if they are wrong, with 0 after --help."""
    parser = argparse.ArgumentParser(
        prog="ethercat-monitor",
        description="Shows what ethercat-server streams, live in the terminal. Keys: ? lists them.",
        epilog="With --once: exit 0 if all is fine, 1 if there is no server or a sensor has an error.",
    )
    add_address(parser)
    parser.add_argument("--once", action="store_true", help="print a table of one second and end")
    parser.add_argument("--json", action="store_true", help="print a JSON object a second; with --once, one")
    parser.add_argument("--seconds", type=seconds, metavar="S", help="end by itself after S seconds")
    add_imu_units(parser)
    parser.add_argument("--ascii", action="store_true", help="use ASCII characters only")
    parser.add_argument("--version", action="version", version=f"%(prog)s {VERSION}")
    given = parser.parse_args(argv)
    if given.once and given.seconds is not None:
        parser.error("--seconds does not go with --once, which ends by itself")
    return Options(
        given.address, given.once, given.json, given.seconds, ImuUnits(given.imu_raw_units), given.ascii
    )
