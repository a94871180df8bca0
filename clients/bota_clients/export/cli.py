"""`ethercat-export`: its command lines; all else is imported when it is known what is to be done."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from bota_clients.arguments import add_force, add_imu_units, number, parser, position, typed
from bota_clients.program import start
from bota_ethercat.pdo import ImuUnits

PROGRAM: Final = "ethercat-export"
DATASETS: Final = (".parquet", ".zarr", ".npz")
_MOST_SAMPLES: Final = 100_000  # in a window


class ExportOptions(argparse.Namespace):
    """What to export, and where to."""

    recording: Path
    output: Path
    sensor: int | None
    all: bool
    imu_units: ImuUnits
    force: bool
    at: Path | None
    fps: float | None
    column: str | None
    topic: str | None
    window: int
    latency: float  # s
    clock: Path | None
    tool: Path | None
    hold: bool

    @property
    def is_dataset(self) -> bool:
        """Whether it is to be windows of samples, not a table of them."""
        return self.output.suffix in DATASETS


class AlignOptions(argparse.Namespace):
    """What to align."""

    recording: Path
    bag: Path
    topic: str
    urdf: Path | None
    link: str | None
    sensor: int | None
    imu_units: ImuUnits
    json: bool


def parse_options(argv: Sequence[str] | None) -> ExportOptions:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = parser(
        PROGRAM,
        "Writes the samples of a recording as CSV, one a line, or for each camera frame the last samples "
        "that were measured before it, as .parquet, .zarr or .npz.",
        "CSV is for pandas.read_csv(FILE, parse_dates=['stamp_utc']), MATLAB's readtable, or a spreadsheet. "
        "'ethercat-export align' finds the offset of another computer's clock.",
    )
    add = made.add_argument
    _add_recording(made)
    add("output", type=Path, nargs="?", metavar="OUT",
        help="file to write (default: RECORDING.csv, with --at or --fps RECORDING.parquet)")  # fmt: skip
    add("--all", action="store_true", help="CSV: also frames that are no new sample: repeated, invalid")
    frames = made.add_argument_group("for each camera frame").add_argument
    frames("--at", type=Path, metavar="FRAMES", help="times of the frames: CSV, Parquet, or a bag")
    frames("--column", metavar="NAME", help="the column of FRAMES")
    frames("--topic", metavar="TOPIC", help="the topic of the bag; its header.stamp is taken")
    frames("--fps", type=number(1e-3, 1e5), metavar="HZ", help="instead of --at: frames at this rate")
    frames("--window", type=typed(_window, f"from 1 to {_MOST_SAMPLES}"), default=32, metavar="K",
           help="samples for each frame (default 32)")  # fmt: skip
    frames("--latency", type=number(-60, 60), default=0.0, metavar="S",
           help="seconds from a frame's exposure to its stamp (default 0)")  # fmt: skip
    frames("--clock", type=Path, metavar="JSON",
           help="clock of the stamps, by 'ethercat-export align --json' (default: the server's)")  # fmt: skip
    frames("--tool", type=Path, metavar="YAML",
           help="also the compensated wrench, with these parameters of the ROS 2 node")  # fmt: skip
    frames("--hold", action="store_true", help="repeat the last sample where one was lost, instead of NaN")
    add_force(made)
    options = made.parse_args(argv, ExportOptions())
    has_frames = options.at is not None or options.fps is not None
    suffix = ".parquet" if has_frames else ".csv"
    options.output = options.output or options.recording.with_suffix(suffix)
    if options.output.absolute() == options.recording.absolute():
        made.error("the output would overwrite the recording: give another name")
    if options.at is not None and options.fps is not None:
        made.error("give --at or --fps, not both")
    if options.is_dataset != has_frames:
        made.error(f"windows of samples, with --at or --fps, are written as {', '.join(DATASETS)} only")
    return options


def parse_align(argv: Sequence[str]) -> AlignOptions:
    """Read the command line after `align`."""
    made = parser(
        f"{PROGRAM} align",
        "Finds the offset between the server's clock and a robot's, and its drift: from the angular rate of "
        "the sensor's IMU and that of an IMU of the robot, or of its joints.",
        "Both on one link, with any axes. Record both while the robot turns the sensor about several axes, "
        "not periodically, for half a minute or more.",
    )
    _add_recording(made)
    add = made.add_argument
    add("bag", type=Path, metavar="BAG", help="a bag of ROS: the folder, .mcap, .db3 or .bag")
    add("--topic", required=True, metavar="TOPIC", help="sensor_msgs/Imu or sensor_msgs/JointState")
    add("--urdf", type=Path, metavar="FILE", help="of joint states: the robot")
    add("--link", metavar="NAME", help="of joint states: the link that carries the sensor")
    add("--json", action="store_true", help="print JSON, for --clock")
    options = made.parse_args(argv, AlignOptions())
    if (options.urdf is None) != (options.link is None):
        made.error("joint states need both --urdf and --link")
    return options


def _add_recording(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    add("recording", type=Path, metavar="RECORDING", help="a recording of ethercat-record")
    add("--sensor", type=position, metavar="N", help="only the sensor at this position on the bus")
    add_imu_units(made)


def _window(text: str) -> int:
    if 1 <= (samples := int(text)) <= _MOST_SAMPLES:
        return samples
    raise ValueError


def main(argv: Sequence[str] | None = None) -> int:
    """Export; returns the exit code."""
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["align"]:
        return start(PROGRAM, "export.align", parse_align(given[1:]))
    options = parse_options(given)
    return start(PROGRAM, "export.dataset" if options.is_dataset else "export.table", options)
