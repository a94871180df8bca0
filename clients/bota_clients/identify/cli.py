"""`ethercat-identify` and its `delay`: command lines; all else is imported after Ctrl-C is handled."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from bota_clients.arguments import add_force, position
from bota_clients.program import start
from bota_clients.recording.asked import add_reading
from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.program.arguments import Parser, number
from bota_ethercat.program.output import ends_with_its_reader


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = Parser(
        "ethercat-identify",
        "Identifies mass and center of gravity of the tool and the bias of the sensor from a recording in "
        "which the sensor was held stationary in several poses.",
        "Record with ethercat-record: hold the sensor stationary for two seconds with each axis once up "
        "and once down, touching nothing; or turn it to and fro for 20 s. 'ethercat-identify delay' tells "
        "how much later force and torque are than the accelerometer. A FILE.json of Bota's payload "
        "utilities is converted by --yaml, and a FILE.yaml of this program by --bota.",
    )
    add = made.add_argument
    _add_recording(made)
    add("--gravity", type=number(9.0, 10.0), metavar="M/S2",
        help=f"acceleration of gravity, m/s² ({STANDARD_GRAVITY}); written to OUT.yaml if given")  # fmt: skip
    add("--yaml", type=Path, metavar="OUT", help="write the result as parameters of the ROS 2 node")
    add("--bota", type=Path, metavar="OUT",
        help="write mass, center of gravity and inertia for Bota's BotaPayloadCompensator")  # fmt: skip
    add_force(made)
    add("--json", action="store_true", help="print everything as JSON instead of a table")
    return made.parse_args(argv)


def parse_delay(argv: Sequence[str]) -> argparse.Namespace:
    made = Parser(
        "ethercat-identify delay",
        "Tells from a recording how much later force and torque are than the accelerometer.",
        "Record with ethercat-record for 10 s: shake the sensor with its tool by hand, two to five times a "
        "second in all directions, touching nothing with the tool.",
    )
    _add_recording(made)
    made.add_argument("--json", action="store_true", help="print JSON instead of a sentence")
    return made.parse_args(argv)


def _add_recording(made: argparse.ArgumentParser) -> None:
    made.add_argument("path", type=Path, metavar="FILE.mcap", help="a recording of ethercat-record")
    made.add_argument("--sensor", type=position, metavar="N",
        help="position on the bus (default: the only one in the recording)")  # fmt: skip
    add_reading(made)


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["delay"]:
        return start("ethercat-identify", "identify.delay", parse_delay(given[1:]))
    options = parse_options(given)
    is_tool = options.path.suffix in {".json", ".yaml", ".yml"}
    return start("ethercat-identify", "identify.tool_file" if is_tool else "identify.program", options)


if __name__ == "__main__":
    sys.exit(main())
