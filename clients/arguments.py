"""Arguments that several of the programs here take, so that they are named, read and refused alike."""

from __future__ import annotations

import argparse

from protocol.address import DEFAULT_HOST, DEFAULT_PORT, Address
from protocol.pdo import ImuUnits


def add_address(parser: argparse.ArgumentParser) -> None:
    """HOST:PORT of the server, which may be left out."""
    default = Address(DEFAULT_HOST, DEFAULT_PORT)
    parser.add_argument(
        "address", type=address, nargs="?", default=default, metavar="HOST:PORT",
        help=f"the server (default {default})",
    )  # fmt: skip


def add_imu_units(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """What the firmware sends acceleration and angular rate in; the help says for which `purpose`."""
    what = f"what the sensor sends acceleration and angular rate in{purpose and f', for {purpose}'}"
    parser.add_argument(
        "--imu-raw-units", choices=[units.value for units in ImuUnits], default=ImuUnits.G_DPS.value,
        help=f"{what} (default {ImuUnits.G_DPS.value})",
    )  # fmt: skip


def address(text: str) -> Address:
    """A server's address; ArgumentTypeError says what is wrong with it."""
    try:
        return Address.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def seconds(text: str) -> float:
    """A time, s, more than none; ArgumentTypeError says what is wrong with it."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if 0 < value <= 1e9:
        return value
    raise argparse.ArgumentTypeError(f"{text!r}: it must be seconds, such as 60")
