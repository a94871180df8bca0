"""The command line of `ethercat-record`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from clients.arguments import add_address, add_imu_units, seconds
from clients.recording.file_format import MAX_SENSOR
from clients.version import VERSION
from protocol.address import Address
from protocol.pdo import ImuUnits

_UNITS: Final = {"": 1, "k": 10**3, "M": 10**6, "G": 10**9}
_SIZE: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)([kMG]?)B?", re.ASCII)
_LEAST_SIZE: Final = 100_000
_LEAST_SECONDS: Final = 1.0


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """What is to be recorded, and where."""

    path: Path
    address: Address
    sensors: tuple[int, ...] | None
    seconds: float | None
    ros: bool
    namespaces: tuple[str, ...] | None
    imu_units: ImuUnits
    rotate_size: int | None
    rotate_seconds: float | None
    force: bool
    wait: bool
    reconnect: bool
    until_eof: bool


def parse_options(argv: Sequence[str] | None) -> RecordOptions:
    """Read the command line; argparse ends with exit code 2 for what is wrong."""
    parser = argparse.ArgumentParser(
        prog="ethercat-record",
        description="Records what ethercat-server streams, as it came, into an MCAP file.",
        epilog="Ctrl-C ends the recording. Sizes in bytes, or such as 500k, 100M, 2G.",
    )
    add = parser.add_argument
    add("path", type=Path, metavar="OUT.mcap", help="file to make")
    add_address(parser)
    add("--sensor", type=_place, action="append", dest="sensors", metavar="N",
        help="only the sensor at this place on the bus; may be given more than once")  # fmt: skip
    add("--seconds", type=seconds, metavar="S", help="end by itself after so long")
    add("--ros", action="store_true",
        help="also write what the ROS 2 node would publish: WrenchStamped, Imu, Temperature")  # fmt: skip
    add("--ros-namespace", type=_namespace, action="append", dest="namespaces", metavar="NAME",
        help="namespace of their topics, one for each sensor in turn (default none for one sensor, sensor_0, "
        "sensor_1, ... for several)")  # fmt: skip
    add_imu_units(parser, "--ros")
    add("--rotate-size", type=_size, metavar="SIZE", help="begin a new file whenever one has this size")
    add("--rotate-seconds", type=_rotate_seconds, metavar="S", help="begin a new file every S seconds")
    add("--force", action="store_true", help="replace files that exist")
    add("--wait", action="store_true", help="wait for a server that is not there yet")
    add("--no-reconnect", action="store_false", dest="reconnect",
        help="end when the server does, instead of waiting for its return")  # fmt: skip
    add("--until-eof", action="store_true",
        help="end when standard input does, so with the program that holds its other end")  # fmt: skip
    add("--version", action="version", version=f"%(prog)s {VERSION}")
    given = parser.parse_intermixed_args(argv)
    if given.namespaces is not None and not given.ros:
        parser.error("--ros-namespace goes with --ros")
    sensors = tuple(sorted(set(given.sensors))) if given.sensors else None
    return RecordOptions(
        given.path, given.address, sensors, given.seconds, given.ros,
        tuple(given.namespaces) if given.namespaces else None, ImuUnits(given.imu_raw_units),
        given.rotate_size, given.rotate_seconds, given.force, given.wait, given.reconnect,
        given.until_eof,
    )  # fmt: skip


def _place(text: str) -> int:
    if text.isascii() and text.isdecimal() and int(text) <= MAX_SENSOR:
        return int(text)
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a place on the bus, from 0")


def _rotate_seconds(text: str) -> float:
    value = seconds(text)
    if value >= _LEAST_SECONDS:
        return value
    raise argparse.ArgumentTypeError(f"{text!r}: it must be at least {_LEAST_SECONDS:g} s")


def _size(text: str) -> int:
    match = _SIZE.fullmatch(text)
    size = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if size >= _LEAST_SIZE:
        return size
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a size such as 100M, at least 100k")


def _namespace(text: str) -> str:
    name = text.strip("/")
    if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*", name, re.ASCII):
        return name
    raise argparse.ArgumentTypeError(f"{text!r}: it must be a ROS namespace, such as left_arm")
