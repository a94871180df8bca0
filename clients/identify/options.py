"""The command line of `ethercat-identify`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final

from bridge.compensation.still import StillLimits
from clients.arguments import add_imu_units
from clients.version import VERSION
from protocol.pdo import STANDARD_GRAVITY, ImuUnits

_LIMITS: Final = tuple(field.name for field in fields(StillLimits))
_MAX_SENSOR: Final = 255


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """What to read, and how."""

    path: Path
    sensor: int | None
    imu_units: ImuUnits
    gravity: float | None
    """m/s², if it was given."""
    least_seconds: float
    limits: StillLimits
    confidence: float
    one_axis: bool
    yaml: Path | None
    json: bool


def parse_options(argv: Sequence[str] | None) -> IdentifyOptions:
    """Read the command line; argparse ends with exit code 2 for what is wrong."""
    parser = argparse.ArgumentParser(
        prog="ethercat-identify",
        description="Finds mass and centre of gravity of what hangs on the sensor, and the sensor's bias, "
        "from a recording in which it was held still in several poses.",
        epilog="Record with ethercat-record: hold the sensor still for two seconds with each axis once up "
        "and once down, touching nothing. The moves between may be of any kind.",
    )
    add = parser.add_argument
    add("path", type=Path, metavar="FILE.mcap", help="recording of ethercat-record")
    add("--sensor", type=_between(int, 0, _MAX_SENSOR), metavar="N",
        help="place on the bus (default: the only one in the recording)")  # fmt: skip
    add_imu_units(parser)
    add("--gravity", type=_between(float, 9.0, 10.0), metavar="M/S2",
        help=f"acceleration of gravity, m/s² ({STANDARD_GRAVITY}); OUT.yaml has it if given")  # fmt: skip
    add("--least-seconds", type=_between(float, 0.3, 3600.0), default=1.0, metavar="S",
        help="a shorter rest is no pose (default 1)")  # fmt: skip
    add("--limit", type=_limit, action="append", default=[], metavar="NAME=VALUE",
        help=f"another limit of what counts as rest: {', '.join(_LIMITS)}")  # fmt: skip
    add("--confidence", type=_between(float, 0.5, 0.9999), default=0.95, metavar="P",
        help="of the intervals (default 0.95)")  # fmt: skip
    add("--one-axis", action="store_true",
        help="take poses that turn about one axis only; nothing checks the answer along it")  # fmt: skip
    add("--yaml", type=Path, metavar="OUT", help="write the answer as parameters of the ROS 2 node")
    add("--json", action="store_true", help="print everything as JSON instead of a table")
    add("--version", action="version", version=f"%(prog)s {VERSION}")
    parsed = parser.parse_args(argv)
    return IdentifyOptions(
        parsed.path, parsed.sensor, ImuUnits(parsed.imu_raw_units), parsed.gravity, parsed.least_seconds,
        replace(StillLimits(), **dict(parsed.limit)), parsed.confidence, parsed.one_axis, parsed.yaml,
        parsed.json,
    )  # fmt: skip


def _between(kind: Callable[[str], float], low: float, high: float) -> Callable[[str], float]:
    def convert(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r}: it must be from {low:g} to {high:g}")
        return value

    return convert


def _limit(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    if name not in _LIMITS:
        raise argparse.ArgumentTypeError(f"{text!r}: it must be NAME=VALUE, NAME one of {', '.join(_LIMITS)}")
    value = _between(float, 0.0, 1e6)(number)
    return name, int(value) if name == "least_samples" else value
