"""The command line of `ethercat-report`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from clients.arguments import add_imu_units, address
from clients.version import VERSION
from protocol.address import Address
from protocol.pdo import ImuUnits
from protocol.sensor_choice import MEANING, SensorChoice

LONGEST_S: Final = 1800.0
_EXIT_CODES: Final = (
    "exit code: 0 healthy, 1 no report was made, 2 wrong usage, 3 nothing wrong was found but not "
    "everything could "
    "be checked, 4 attention, 5 fault"
)


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """What to report on, and where to."""

    recording: Path | None
    """None: live."""
    server: Address
    seconds: float
    output: Path
    sensor: SensorChoice | None
    imu_units: ImuUnits
    note: str
    json: bool


def parse_options(argv: Sequence[str] | None) -> ReportOptions:
    """Read the command line; argparse ends with exit code 2 for what is wrong."""
    parser = argparse.ArgumentParser(
        prog="ethercat-report",
        description="Makes one page that says how a sensor is, from a recording or from some seconds of "
        "a live stream.",
        epilog=_EXIT_CODES,
    )
    add = parser.add_argument
    add("recording", type=Path, nargs="?", metavar="FILE.mcap", help="what ethercat-record wrote")
    add("--server", type=address, metavar="HOST:PORT", help="instead of a recording: listen to this server")
    add("--seconds", type=_seconds, metavar="S", help="how long to listen (default 10)")
    add("-o", "--output", type=Path, metavar="REPORT.html",
        help="where to write the page (default: beside the recording, or report.html)")  # fmt: skip
    add("--sensor", type=_choice, metavar="S", help=f"only this sensor: {MEANING}")
    add_imu_units(parser)
    add("--note", default="", metavar="TEXT", help="a remark of yours for the head of the page")
    add("--json", action="store_true", help="print the checks as JSON too")
    add("--version", action="version", version=f"%(prog)s {VERSION}")
    given = parser.parse_args(argv)
    if (given.recording is None) == (given.server is None):
        parser.error("give a recording, or --server HOST:PORT")
    if given.seconds is not None and given.server is None:
        parser.error("--seconds goes with --server")
    output = given.output
    if output is None:
        output = given.recording.with_suffix(".html") if given.recording else Path("report.html")
    if given.recording is not None and output.absolute() == given.recording.absolute():
        parser.error("the report would replace the recording: give another name with -o")
    return ReportOptions(
        given.recording, given.server or Address.parse(""), given.seconds or 10.0, output, given.sensor,
        ImuUnits(given.imu_raw_units), given.note, given.json,
    )  # fmt: skip


def _choice(text: str) -> SensorChoice:
    try:
        return SensorChoice.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} must be {error}") from None


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1.0 <= value <= LONGEST_S:
        raise argparse.ArgumentTypeError(
            f"{text!r} must be a number of seconds from 1 to {LONGEST_S:g}; for longer make a recording"
        )
    return value
