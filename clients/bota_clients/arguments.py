"""Arguments that several of the programs here take, so that they are named, read and refused alike."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TypeVar

from bota_ethercat.address import Address
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.program import server_choice
from bota_ethercat.sensor_choice import MOST_PLACES

_Value = TypeVar("_Value")


def add_server(parser: argparse.ArgumentParser, what: str = "the server") -> None:
    """`--server HOST:PORT`; see `server_of`."""
    parser.add_argument("--server", type=address, metavar="HOST:PORT", help=f"{what} {server_choice.HELP}")


def server_of(parser: argparse.ArgumentParser, given: Address | None) -> Address:
    """The server `given` with --server, or the default; the parser ends the program if that is wrong."""
    try:
        return given or server_choice.default_server()
    except ValueError as error:
        parser.error(str(error))


def add_force(parser: argparse.ArgumentParser) -> None:
    """`--force`: nothing is overwritten without it."""
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def add_imu_units(parser: argparse.ArgumentParser) -> None:
    """Units in which the firmware sends acceleration and angular rate."""
    values = [units.value for units in ImuUnits]
    parser.add_argument(
        "--imu-raw-units", type=typed(ImuUnits, " or ".join(values)), default=ImuUnits.G_DPS,
        dest="imu_units", metavar=f"{{{','.join(values)}}}",
        help="units in which the sensor sends acceleration and angular rate "
        f"(default {ImuUnits.G_DPS.value})",
    )  # fmt: skip


def typed(convert: Callable[[str], _Value], what: str = "") -> Callable[[str], _Value]:
    """The type of an argument; for a ValueError argparse says `what` it must be, or else the error."""

    def converted(text: str) -> _Value:
        try:
            return convert(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r}: it must be {what}" if what else str(error)) from None

    return converted


def number(low: float, high: float, what: str = "") -> Callable[[str], float]:
    """The type of an argument that is a number from `low` to `high`; `what` is in the error if it is not."""

    def within(text: str) -> float:
        if low <= (value := float(text)) <= high:
            return value
        raise ValueError

    return typed(within, what or f"from {low:g} to {high:g}")


def _position(text: str) -> int:
    if text.isascii() and text.isdecimal() and int(text) < MOST_PLACES:
        return int(text)
    raise ValueError


address = typed(Address.parse)
seconds = number(1e-9, 1e9, "a number of seconds, such as 60")
position = typed(_position, f"a position on the bus, from 0 to {MOST_PLACES - 1}")
