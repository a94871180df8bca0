"""Arguments that several of the programs here take, so that they are named, read and refused alike."""

from __future__ import annotations

import argparse
import ipaddress
import re
from typing import Final

from bota_ethercat.address import Address
from bota_ethercat.option_types import choice
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.program import server_choice
from bota_ethercat.program.arguments import typed, whole
from bota_ethercat.sensor_choice import MAX_SENSORS

_UNITS_S: Final = {"": 1, "s": 1, "m": 60, "h": 3600}  # by their first letter
DURATION_UNIT: Final = "s(?:ec(?:ond)?s?)?|m(?:in(?:ute)?s?)?|h(?:(?:ou)?rs?)?"


def add_server(parser: argparse.ArgumentParser) -> None:
    """`--server HOST:PORT`; see `server_of`."""
    parser.add_argument(
        "--server", type=address, metavar="HOST:PORT", help=f"the server {server_choice.HELP}"
    )


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
        "--imu-raw-units", type=typed(ImuUnits, choice(*values).allowed), default=ImuUnits.G_DPS,
        dest="imu_units", metavar=f"{{{','.join(values)}}}",
        help="units in which the sensor sends acceleration and angular rate "
        f"(default {ImuUnits.G_DPS.value})",
    )  # fmt: skip


def duration(text: str) -> float:
    """Seconds in a text such as 30, 30s, 5min, 2h; ValueError."""
    match = re.fullmatch(rf"([0-9]+(?:\.[0-9]+)?) ?({DURATION_UNIT}|)", text, re.ASCII)
    if match and (value := float(match[1]) * _UNITS_S[match[2][:1]]) <= 1e9:
        return value
    raise ValueError


def is_loopback(host: str) -> bool:
    """Whether a host, without port, is this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


address = typed(Address.parse)
position = whole(0, MAX_SENSORS - 1)
