"""Arguments that several of the programs here take, so that they are named, read and refused alike."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from bota_ethercat.address import Address
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.program import server_choice
from bota_ethercat.program.completion import add_completion
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor_choice import MOST_PLACES


def parser(prog: str, description: str, epilog: str, usage: str | None = None) -> argparse.ArgumentParser:
    """The parser of a program, with --version."""
    made = argparse.ArgumentParser(prog=prog, usage=usage, description=description, epilog=epilog)
    made.add_argument("--version", action="version", version=f"%(prog)s {VERSION}")
    add_completion(made)
    return made


def add_server(parser: argparse.ArgumentParser, what: str = "the server") -> None:
    """`--server HOST:PORT`; see `server_of`."""
    parser.add_argument("--server", type=address, metavar="HOST:PORT", help=f"{what} {server_choice.HELP}")


def server_of(parser: argparse.ArgumentParser, given: Address | None, argument: str | None = None) -> Address:
    """The server `given` with --server or by the old form, an `argument` without --server, or the default.

    The parser ends the program if it is wrong, or given twice.
    """
    if given is not None and argument is not None:
        parser.error(f"the server is given twice: leave out {argument}, or --server")
    try:
        return given or (server_choice.default_server() if argument is None else Address.parse(argument))
    except ValueError as error:
        parser.error(str(error))


def file_and_server(parser: argparse.ArgumentParser, names: list[str]) -> tuple[Path, str | None]:
    """The file among the arguments FILE [HOST:PORT], in either order, and the address."""
    if len(names) > 1 and server_choice.is_address(names[0]) and not server_choice.is_address(names[1]):
        names = [names[1], names[0], *names[2:]]
    if server_choice.is_address(names[0]):
        parser.error(
            f"{names[0]} is a server's address, no file: write FILE.mcap --server {names[0]}, "
            f"or ./{names[0]} if a file is called so"
        )
    if len(names) > 2:
        parser.error(f"unexpected argument {names[2]!r}")
    return Path(names[0]), names[1] if len(names) == 2 else None


def add_force(parser: argparse.ArgumentParser) -> None:
    """`--force`: nothing is overwritten without it."""
    parser.add_argument("--force", action="store_true", help="replace an existing file")


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
