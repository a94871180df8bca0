"""What `ethercat-identify` does: reads a recording, finds the stationary periods, identifies, reports."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from bota_clients.errors import RecordingError
from bota_clients.identify.options import IdentifyOptions, parse_options
from bota_clients.identify.stationary_periods import (
    StationaryPeriod,
    StationaryPeriods,
    find_stationary_periods,
)
from bota_clients.program import discard_output, say
from bota_clients.recording.columns import columns
from bota_clients.recording.reader import RecordedSensor, Recording, open_recording
from bota_ethercat.errors import FileError
from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.program.new_file import refuse_existing
from ft_compensation.identification.parameter_file import write_yaml
from ft_compensation.identification.payload import Fit, Identified, OffsetFit, identify, summary
from ft_compensation.identification.poses import MOST_POSES, Pose, pose_of
from ft_compensation.quantities import CompensationError, Wrench


def show_poses(
    console: Console, periods: Sequence[StationaryPeriod], poses: Sequence[Pose], result: Identified | None
) -> None:
    """The poses with their residuals."""
    table = Table(title="poses", title_justify="left")
    for head in ("", "at s", "for s", "samples", "up x", "up y", "up z", "residual N", "residual Nm"):
        table.add_column(head, justify="right")
    for number, (period, pose) in enumerate(zip(periods, poses, strict=True)):
        left = ["", ""]
        if result is not None:
            residual = result.residuals[number]
            left = [f"{_length(residual.force):.3f}", f"{_length(residual.torque):.5f}"]
        table.add_row(
            str(number + 1), f"{period.begin_s:.1f}", f"{period.seconds:.1f}", str(pose.samples),
            *(f"{round(part, 2) + 0.0:.2f}" for part in pose.up), *left,
        )  # fmt: skip
    console.print(table)


def show_result(console: Console, result: Identified) -> None:
    """The parameters with their intervals, and notes."""
    table = Table(title="payload and bias", title_justify="left")
    table.add_column("")
    table.add_column("value", justify="right")
    table.add_column(f"± ({100 * result.confidence:g} %)", justify="right")
    table.add_column("unit")
    table.add_row("mass", f"{result.payload.mass:.4f}", f"{result.mass_interval:.4f}", "kg")
    for axis, value, interval in zip("xyz", result.payload.center, result.centre_interval, strict=True):
        table.add_row(f"center of gravity {axis}", f"{1000 * value:.2f}", f"{1000 * interval:.2f}", "mm")
    _add_bias(table, result.bias, result.bias_interval)
    if (fit := result.accelerometer) is not None:
        found = fit.calibration
        for axis, value, half in zip("xyz", found.offset, found.offset_interval, strict=True):
            table.add_row(f"accelerometer offset {axis}", f"{value:.3f}", f"{half:.3f}", "m/s²")
        for axis, value, half in zip("xyz", found.scale, found.scale_interval, strict=True):
            table.add_row(f"accelerometer scale {axis}", f"{value:.4f}", f"{half:.4f}", "")
    console.print(table)
    console.print(
        f"residual: {_fit(result.force_fit, 'N')}, {_fit(result.torque_fit, 'Nm')}; condition number "
        f"{result.condition:.2f} (1.2 is ideal)"
    )
    for note in result.notes:
        console.print(f"note: {note}")


def _add_bias(table: Table, bias: Wrench, interval: Wrench) -> None:
    for axis, value, half in zip("xyz", bias.force, interval.force, strict=True):
        table.add_row(f"bias force {axis}", f"{value:.3f}", f"{half:.3f}", "N")
    for axis, value, half in zip("xyz", bias.torque, interval.torque, strict=True):
        table.add_row(f"bias torque {axis}", f"{value:.5f}", f"{half:.5f}", "Nm")


def as_json(
    found: StationaryPeriods, poses: Sequence[Pose], result: Identified | None, error: str | None
) -> dict[str, Any]:
    """Everything, in SI units; `ok` is whether there is a result."""
    rows = [
        {
            "begin_s": period.begin_s, "seconds": period.seconds, "samples": pose.samples,
            "force": pose.wrench.force, "torque": pose.wrench.torque, "gravity": pose.gravity,
            "force_spread": pose.force_spread, "torque_spread": pose.torque_spread,
        }
        for period, pose in zip(found.periods, poses, strict=True)
    ]  # fmt: skip
    if result is None:
        return {"ok": False, "error": error, "poses": rows, "rejected": list(found.rejected)}
    for row, residual in zip(rows, result.residuals, strict=True):
        row["residual_force"], row["residual_torque"] = residual.force, residual.torque
    return {
        "ok": True,
        "tool_mass": result.payload.mass,
        "tool_mass_interval": result.mass_interval,
        "tool_center_of_gravity": result.payload.center,
        "tool_center_of_gravity_interval": result.centre_interval,
        "bias": result.bias.values,
        "bias_interval": result.bias_interval.values,
        "confidence": result.confidence,
        "force_rms": result.force_rms,
        "torque_rms": result.torque_rms,
        "force_fit": result.force_fit._asdict(),
        "torque_fit": result.torque_fit._asdict(),
        "accelerometer": _accelerometer(result.accelerometer),
        "condition": result.condition,
        "gravity": result.gravity,
        "notes": list(result.notes),
        "poses": rows,
        "rejected": list(found.rejected),
    }


def _fit(fit: Fit, unit: str) -> str:
    times = "" if fit.chi_square is None else f", {fit.chi_square**0.5:.1f} times the noise"
    return f"{fit.rms:.3g} {unit} ({fit.verdict}{times})"


def _accelerometer(fit: OffsetFit | None) -> dict[str, Any] | None:
    if fit is None:
        return None
    return {**fit.calibration._asdict(), "undetermined": fit.undetermined}


def _length(values: Sequence[float]) -> float:
    return float(sum(value * value for value in values) ** 0.5)


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
