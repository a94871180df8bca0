"""The command line of `ethercat-report`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_clients.arguments import add_force, add_imu_units, add_server, number, parser, server_of
from bota_ethercat.address import Address
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.program.server_choice import is_address
from bota_ethercat.sensor_choice import MEANING, SensorChoice

LONGEST_S: Final = 1800.0
_DEFAULT_S: Final = 10.0


class ReportOptions(argparse.Namespace):
    """What to report on, and where to."""

    recording: Path | None
    """None: live."""
    server: Address | None
    """None: from a recording."""
    seconds: float
    output: Path
    force: bool
    sensor: SensorChoice | None
    imu_units: ImuUnits
    note: str
    json: bool


def parse_options(argv: Sequence[str] | None) -> ReportOptions:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = parser(
        "ethercat-report",
        "Writes a one-page sensor health report (HTML) from a recording or a live stream.",
        "exit code: 0 good, worth a look or not conclusive, 1 trouble, or no report was made, 2 wrong usage",
    )
    add = made.add_argument
    add("recording", type=Path, nargs="?", metavar="FILE.mcap",
        help="a recording of ethercat-record (default: listen to the server)")  # fmt: skip
    add_server(made, "listen to this server")
    longest = number(
        1, LONGEST_S, f"a number of seconds from 1 to {LONGEST_S:g}; for longer make a recording"
    )
    add("--seconds", type=longest, metavar="S", help=f"how long to listen (default {_DEFAULT_S:g})")
    add("-o", "--output", type=Path, metavar="REPORT.html",
        help="where to write the page (default: beside the recording, or report.html)")  # fmt: skip
    add_force(made)
    add("--sensor", type=_choice, metavar="S", help=f"only this sensor: {MEANING}")
    add_imu_units(made)
    add("--note", default="", metavar="TEXT", help="a remark for the head of the page")
    add("--json", action="store_true", help="print the checks as JSON")
    options = made.parse_args(argv, ReportOptions())
    recording, listen_s = options.recording, vars(options)["seconds"]
    if recording is not None and is_address(str(recording)) and not recording.exists():
        made.error(f"{recording} is a server's address, no recording: write --server {recording}")
    if recording is None:
        options.server = server_of(made, options.server)
    elif options.server is not None:
        made.error("give a recording, or --server HOST:PORT, not both")
    elif listen_s is not None:
        made.error("--seconds is for listening to a server: the whole recording is examined")
    options.seconds = listen_s or _DEFAULT_S
    options.output = options.output or (recording.with_suffix(".html") if recording else Path("report.html"))
    if recording is not None and options.output.absolute() == recording.absolute():
        made.error("the report would overwrite the recording: give another name with -o")
    return options


def _choice(text: str) -> SensorChoice:
    try:
        return SensorChoice.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} must be {error}") from None
