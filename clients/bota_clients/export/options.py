"""The command line of `ethercat-export`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from bota_clients.arguments import add_force, add_imu_units, parser, position
from bota_ethercat.pdo import ImuUnits


class ExportOptions(argparse.Namespace):
    """What to export, and where to."""

    recording: Path
    output: Path
    sensor: int | None
    all: bool
    imu_units: ImuUnits
    force: bool


def parse_options(argv: Sequence[str] | None) -> ExportOptions:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = parser(
        "ethercat-export",
        "Writes the samples of a recording as CSV: a line of names with units, then one per sample.",
        "For pandas.read_csv(FILE, parse_dates=['stamp_utc']), MATLAB's readtable, or a spreadsheet.",
    )
    add = made.add_argument
    add("recording", type=Path, metavar="FILE.mcap", help="a recording of ethercat-record")
    add("output", type=Path, nargs="?", metavar="OUT.csv", help="file to write (default: FILE.csv)")
    add("--sensor", type=position, metavar="N", help="only the sensor at this position on the bus")
    add("--all", action="store_true", help="also frames that are no new sample: repeated, invalid")
    add_imu_units(made)
    add_force(made)
    options = made.parse_args(argv, ExportOptions())
    options.output = options.output or options.recording.with_suffix(".csv")
    if options.output.absolute() == options.recording.absolute():
        made.error("the table would overwrite the recording: give another name")
    return options
