"""Arguments that several of the programs here take, so that they are named, read and refused alike."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from clients.program import VERSION
from protocol.address import DEFAULT_HOST, DEFAULT_PORT, Address
from protocol.pdo import ImuUnits
from protocol.sensor_choice import MOST_PLACES


def parser(prog: str, description: str, epilog: str, usage: str | None = None) -> argparse.ArgumentParser:
    """The parser of a program, with --version."""
    made = argparse.ArgumentParser(prog=prog, usage=usage, description=description, epilog=epilog)
    made.add_argument("--version", action="version", version=f"%(prog)s {VERSION}")
    return made


def add_address(parser: argparse.ArgumentParser) -> None:
    """HOST:PORT of the server, optional."""
    default = Address(DEFAULT_HOST, DEFAULT_PORT)
    parser.add_argument(
        "address", type=address, nargs="?", default=default, metavar="HOST:PORT",
        help=f"the server (default {default})",
    )  # fmt: skip


def add_imu_units(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """Units in which the firmware sends acceleration and angular rate; `purpose` is for the help."""
    parser.add_argument(
        "--imu-raw-units", type=_units, default=ImuUnits.G_DPS, dest="imu_units",
        metavar=f"{{{','.join(units.value for units in ImuUnits)}}}",
        help=f"units in which the sensor sends acceleration and angular rate{purpose and f', for {purpose}'} "
        f"(default {ImuUnits.G_DPS.value})",
    )  # fmt: skip


def _units(text: str) -> ImuUnits:
    try:
        return ImuUnits(text)
    except ValueError:
        known = " or ".join(units.value for units in ImuUnits)
        raise argparse.ArgumentTypeError(f"{text!r}: it must be {known}") from None


def address(text: str) -> Address:
    """A server's address."""
    try:
        return Address.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def number(low: float, high: float, what: str = "") -> Callable[[str], float]:
    """The type of an argument that is a number from `low` to `high`; `what` is said if it is not."""

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = low - 1
        if low <= value <= high:
            return value
        raise argparse.ArgumentTypeError(f"{text!r}: it must be {what or f'from {low:g} to {high:g}'}")

    return convert


seconds = number(1e-9, 1e9, "a number of seconds, such as 60")


def position(text: str) -> int:
    """A sensor's position on the bus."""
    if text.isascii() and text.isdecimal() and int(text) < MOST_PLACES:
        return int(text)
    raise argparse.ArgumentTypeError(
        f"{text!r}: it must be a position on the bus, from 0 to {MOST_PLACES - 1}"
    )
