"""`ethercat-export`: its command lines; all else is imported when it is known what is to be done."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Final

from bota_clients.arguments import add_force, position
from bota_clients.program import interrupt_on_signals, say, start
from bota_clients.recording.asked import Asked, add_reading
from bota_ethercat.errors import FileError
from bota_ethercat.program.arguments import Parser, number
from bota_ethercat.program.output import ends_with_its_reader

PROGRAM: Final = "ethercat-export"
DATASETS: Final = (".parquet", ".zarr", ".npz")
_MOST_SAMPLES: Final = 100_000  # in a window


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = Parser(
        PROGRAM,
        "Writes the samples of a recording, one a row, as CSV, .parquet or .npz, or for each camera frame "
        "the last samples that were measured before it, as .parquet, .zarr or .npz.",
        "CSV is for pandas.read_csv(FILE, parse_dates=['stamp_utc']), MATLAB's readtable, or a spreadsheet. "
        "'ethercat-export align' finds the offset of another computer's clock.",
    )
    add = made.add_argument
    _add_recording(made)
    add("output", nargs="*", metavar="OUT",
        help="file to write (default: RECORDING.csv, with --at or --fps RECORDING.parquet); a folder, after "
        "one recording or several: data set of all, Parquet by serial and day")  # fmt: skip
    add("--all", action="store_true", help="CSV: also frames that are no new sample: repeated, invalid")
    add("--tool", type=Path, metavar="YAML",
        help="not CSV: also the compensated wrench, with these parameters of the ROS 2 node")  # fmt: skip
    add("--mcap", type=Path, metavar="OUT",
        help="write the recording into a complete MCAP file, also if it was cut off")  # fmt: skip
    add("--ros", type=Path, metavar="OUT",
        help="write the samples as ROS topics (wrench, imu/data_raw, ...) into an MCAP file")  # fmt: skip
    add_force(made)
    group = made.add_argument_group("for each camera frame")
    add = group.add_mutually_exclusive_group().add_argument
    add("--at", type=Path, metavar="FRAMES", help="times of the frames: CSV, Parquet, or a bag")
    add("--fps", type=number(1e-3, 1e5), metavar="HZ", help="frames at this rate")
    add = group.add_argument
    add("--column", "--topic", dest="column", metavar="NAME", default="timestamp",
        help="column of a table (default timestamp), or topic of a bag (its header.stamp)")  # fmt: skip
    add("--window", type=number(1, _MOST_SAMPLES), default=32, metavar="K",
        help="samples for each frame (default 32)")  # fmt: skip
    add("--latency", type=number(-60, 60), default=0.0, metavar="S",
        help="seconds from a frame's exposure to its stamp (default 0)")  # fmt: skip
    add("--clock", type=Path, metavar="JSON",
        help="clock of the stamps, by 'ethercat-export align' (default: the server's)")  # fmt: skip
    add("--strict", action="store_true",
        help="refuse frames outside of the recording (default: their windows are not valid)")  # fmt: skip
    return _checked(made, made.parse_intermixed_args(argv))


def _checked(made: Parser, options: argparse.Namespace) -> argparse.Namespace:
    """With `recordings` of a data set, `output` and `suffix`; exits with 2 for what does not go together."""
    has_frames = options.at is not None or options.fps is not None
    outputs: list[str] = options.output
    is_folder = len(outputs) > 1 or any(
        each.endswith("/") or (Path(each).is_dir() and Path(each).suffix != ".zarr") for each in outputs
    )
    options.recordings = [options.recording, *map(Path, outputs[:-1])] if is_folder else []
    options.output = Path(outputs[-1]) if outputs else None
    if is_folder:
        if options.mcap or options.ros or options.all or has_frames:
            made.error("a data set has all samples: omit --mcap, --ros, --all, --at, --fps")
        if options.output.suffix or options.output.is_file():
            made.error(f"{options.output}: with several recordings the last name is that of a folder")
        return options
    if options.output and options.output.suffix.lower() == ".mcap" and not options.mcap:
        options.mcap, options.output = options.output, None
    if options.mcap and (options.output or options.all or options.tool or has_frames):
        made.error(
            "--mcap writes the messages as they are: omit the other output, --all, --tool, --at, --fps"
        )
    if options.mcap and (options.rate or options.assignments):
        made.error("--mcap writes the messages as they are: omit --rate, --set")
    if options.ros and (options.output or options.mcap or options.all or has_frames):
        made.error("--ros writes all samples: omit the other output, --mcap, --all, --at, --fps")
    if not options.recording.name:
        made.error(f"{options.recording} is no recording: name an .mcap file")
    options.output = (
        options.mcap
        or options.ros
        or options.output
        or options.recording.with_suffix(DATASETS[0] if has_frames else ".csv")
    )
    if options.output.absolute() == options.recording.absolute():
        made.error("the output would overwrite the recording: give another name")
    is_mcap = bool(options.mcap or options.ros)
    suffix = options.suffix = "" if is_mcap else options.output.suffix.lower()
    if has_frames and suffix not in DATASETS:
        made.error(f"windows of samples, with --at or --fps, are written as {', '.join(DATASETS)} only")
    if suffix == ".zarr" and not has_frames:
        made.error(
            "all samples are written as CSV, .parquet or .npz: choose one of these, or use --at or --fps"
        )
    if not is_mcap and suffix not in {".csv", *DATASETS}:
        made.error(f"{options.output}: the name must end in .csv, .mcap or {', '.join(DATASETS)}")
    if options.tool and not options.ros and suffix not in DATASETS:
        made.error("CSV has no compensated wrench: omit --tool, or write .parquet or .npz")
    if options.all and suffix in DATASETS:
        made.error("--all is for CSV only: omit it")
    return options


def parse_align(argv: Sequence[str]) -> argparse.Namespace:
    made = Parser(
        f"{PROGRAM} align",
        "Finds the offset between the server's clock and a robot's, and its drift: from the angular rate of "
        "the sensor's IMU and that of an IMU of the robot, or of its joints. Prints JSON, for --clock.",
        "Both on one link, with any axes. Record both while the robot turns the sensor about several axes, "
        "not periodically, for half a minute or more.",
    )
    _add_recording(made)
    add = made.add_argument
    add("bag", type=Path, metavar="BAG", help="a bag of ROS: the folder, .mcap, .db3 or .bag")
    add("--topic", required=True, metavar="TOPIC", help="sensor_msgs/Imu or sensor_msgs/JointState")
    add("--urdf", type=Path, metavar="FILE", help="of joint states: the robot")
    add("--link", metavar="NAME", default="", help="of joint states: the link that carries the sensor")
    return made.parse_args(argv)


def _add_recording(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    add("recording", type=Path, metavar="RECORDING", help="a recording of ethercat-record")
    add("--sensor", type=position, metavar="N", help="only the sensor at this position on the bus")
    add_reading(made)


def run(options: argparse.Namespace) -> int:
    """Have the output written, and say what `write` of its module says of it; returns the exit code.

    Ctrl-C ends it at any time and leaves no file.
    """
    from bota_clients.recording.reader import open_recording  # noqa: PLC0415 - needs the extra

    module = "dataset" if options.suffix in DATASETS else "csv_table"
    module = "whole" if options.mcap else "ros_topics" if options.ros else module
    write = import_module(f"bota_clients.export.{module}").write
    interrupt_on_signals()
    try:
        with open_recording(options.recording, Asked.of(options)) as recording:
            for remark in recording.remarks:
                say(PROGRAM, f"{recording.path} {remark}")
            written = write(options, recording)
    except OSError as error:
        raise FileError(f"{options.output} cannot be written: {error.strerror or error}") from None
    except UnicodeEncodeError:  # by pyarrow
        raise FileError(f"{options.output} cannot be written: its name is not UTF-8") from None
    say(PROGRAM, f"{options.output}: {written}")
    return 0


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["align"]:
        return start(PROGRAM, "export.align", parse_align(given[1:]))
    options = parse_options(given)
    return start(PROGRAM, "export.collection" if options.recordings else "export.cli", options)
