"""What `ethercat-identify FILE.mcap` does: finds the stationary poses, solves, prints, writes parameters."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from functools import partial
from typing import Final

from rich.console import Console

from clients.errors import RecordingError
from clients.identify.options import IdentifyOptions, parse_options
from clients.identify.report import as_json, show_poses, show_result
from clients.identify.stationary_periods import StationaryPeriod, StationaryPeriods, find_stationary_periods
from clients.program import discard_output, say
from clients.recording.columns import columns
from clients.recording.reader import RecordedSensor, Recording, open_recording
from ft_compensation.identification.parameter_file import write_yaml
from ft_compensation.identification.payload import Identified, identify, summary
from ft_compensation.identification.poses import MOST_POSES, Pose, pose_of
from ft_compensation.quantities import CompensationError
from protocol.errors import FileError
from protocol.pdo import STANDARD_GRAVITY
from protocol.program.new_file import refuse_existing

_say = partial(say, "ethercat-identify")
_WIDTH: Final = 80
"""Every table fits."""


class SensorChoiceError(CompensationError):
    """The recording does not have the sensor asked for, or has several."""


def run(argv: Sequence[str] | None = None) -> int:
    """Identify; returns the exit code."""
    try:
        return _identify(parse_options(argv))
    except (CompensationError, RecordingError, FileError) as error:
        _say(str(error))
        return 1
    except BrokenPipeError:
        discard_output()
        return 1


def _identify(options: IdentifyOptions) -> int:
    if options.yaml is not None:
        refuse_existing(options.yaml, force=options.force)
    with open_recording(options.path) as recording:
        sensor = _choose(recording, options.sensor)
        if recording.cut_off is not None:
            _say(f"{options.path} was cut off ({recording.cut_off}): the intact part is used")
        data = columns(recording, sensor.sensor, options.imu_units)
    found = find_stationary_periods(data, options.least_seconds, options.limits)
    if len(found.periods) > MOST_POSES:
        longest = sorted(found.periods, key=lambda period: -period.seconds)[:MOST_POSES]
        found = found._replace(periods=tuple(sorted(longest)))
        _say(f"there are more than {MOST_POSES} poses: the longest are used")
    result, error, taken, poses = _solve(found, options)
    if options.json:
        answer = as_json(found._replace(periods=tuple(taken)), poses, result, error)
        sys.stdout.write(json.dumps(answer, indent=1) + "\n")
        sys.stdout.flush()
    else:
        # A narrower terminal wraps the lines: cells would be cut off.
        console = Console(highlight=False, width=max(_WIDTH, Console().width))
        if poses:
            show_poses(console, taken, poses, result)
        if result is not None:
            show_result(console, result)
    for sentence in found.rejected if result is None or not options.json else ():
        _say(f"rejected: {sentence}")
    if result is None:
        _say(error or "no result")
        return 1
    if options.yaml is not None:
        who = f"{sensor.name}, serial number {sensor.serial}, from {options.path.name}"
        gravity = None if options.gravity is None else (0.0, 0.0, -options.gravity)
        write_yaml(options.yaml, result, f"{who}\n{summary(result)}", gravity)
        _say(f"written to {options.yaml}")
    return 0


def _choose(recording: Recording, position: int | None) -> RecordedSensor:
    there = [sensor for sensor in recording.sensors if sensor.frames]
    if not there:
        raise SensorChoiceError(f"{recording.path} has no samples")
    if position is None and len(there) > 1:
        positions = ", ".join(str(sensor.sensor) for sensor in there)
        raise SensorChoiceError(
            f"{recording.path} has several sensors ({positions}): choose one with --sensor"
        )
    for sensor in there:
        if position in (None, sensor.sensor):
            serials = list(dict.fromkeys(row.identity.serial for row in sensor.history))
            if len(serials) > 1:
                raise SensorChoiceError(
                    f"{recording.path}: sensor {sensor.sensor} was replaced during it (serial numbers "
                    f"{', '.join(map(str, serials))}), and each has its own bias: record only one"
                )
            return sensor
    raise SensorChoiceError(f"{recording.path} has no samples of sensor {position}")


def _solve(
    found: StationaryPeriods, options: IdentifyOptions
) -> tuple[Identified | None, str | None, list[StationaryPeriod], list[Pose]]:
    """The result or why there is none, and the stationary periods that are poses."""
    taken, poses = [], []
    reason = None
    for period in found.periods:
        try:
            poses.append(pose_of(period.means, magnitude=options.gravity or STANDARD_GRAVITY))
            taken.append(period)
        except CompensationError as error:
            reason = str(error)
    try:
        if not poses:
            raise CompensationError(
                reason
                or f"the sensor is never stationary for {options.least_seconds:g} s: hold it still, or relax "
                "the limits with --limit or --least-seconds"
            )
        return identify(poses, confidence=options.confidence, one_axis=options.one_axis), None, taken, poses
    except CompensationError as error:
        return None, str(error), taken, poses
