"""What `ethercat-identify` does: reads a recording, finds the stationary periods, identifies, reports."""

from __future__ import annotations

import argparse
import heapq
import json
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from bota_clients.errors import RecordingError
from bota_clients.identify.last_offset import AtLastOffset
from bota_clients.identify.stationary_periods import (
    LEAST_S,
    StationaryPeriod,
    StationaryPeriods,
    tables_of,
    usable,
)
from bota_clients.identify.tool_file import write_bota
from bota_clients.program import say
from bota_clients.recording.asked import Asked
from bota_clients.recording.columns import Floats
from bota_clients.recording.reader import RecordedSensor, Recording, open_recording
from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.program.new_file import refuse_existing
from bota_ft_compensation.alignment import align
from bota_ft_compensation.identification.free_motion import identify_in_motion
from bota_ft_compensation.identification.inertia import turn
from bota_ft_compensation.identification.parameter_file import write_yaml
from bota_ft_compensation.identification.payload import Fit, Identified, TooVagueError, identify, summary
from bota_ft_compensation.identification.poses import MOST_POSES, Pose, pose_of
from bota_ft_compensation.identification.weighted import CONFIDENCE
from bota_ft_compensation.imu import imu_position
from bota_ft_compensation.quantities import (
    CROSS_AXES,
    ELEMENTS,
    EXACT,
    CompensationError,
    Wrench,
    length,
)
from bota_ft_compensation.stream import obstacle

_WIDTH: Final = 80  # every table fits
_PART_S: Final = 10.0
_MOST_MOTION_S: Final = 180.0  # more tells little more, and takes memory
Poses = Sequence[tuple[StationaryPeriod, Pose]]

_say = partial(say, "ethercat-identify")


class Motion:
    """The usable samples of a recording, of a long one those parts in which the sensor turned the most."""

    def __init__(self) -> None:
        self._part, self._seconds = np.zeros((0, 13)), 0.0
        # Those parts, the one that turned least first: how much, from when on and for how long, s; samples.
        self._kept = list[tuple[float, float, float, Floats]]()

    def add(self, table: Floats) -> None:
        """The next of `tables_of`."""
        found = usable(table)
        self._part = np.concatenate([self._part, found])
        if len(found) and table[-1, 0] - self._part[0, 0] > _PART_S:
            self._end_part()

    def rows(self) -> tuple[Floats, Floats]:
        """Times (n,), s since the first sample, and force, torque, acceleration, angular rate (n, 12)."""
        self._end_part()
        parts = (rows for _, _, _, rows in sorted(self._kept, key=lambda each: each[1]))
        found = np.concatenate([self._part, *parts])
        return found[:, 0], np.ascontiguousarray(found[:, 1:])

    def _end_part(self) -> None:
        rows, self._part = self._part, self._part[:0]
        if not len(rows):
            return
        turned, seconds = float(rows[:, 10:].var(axis=0).sum()), float(np.ptp(rows[:, 0]))
        heapq.heappush(self._kept, (turned, float(rows[0, 0]), seconds, rows))
        self._seconds += seconds
        while self._seconds - self._kept[0][2] > _MOST_MOTION_S:
            self._seconds -= heapq.heappop(self._kept)[2]


_right: Final = partial(Column, justify="right")


def show_poses(console: Console, poses: Poses, result: Identified | None) -> None:
    heads = "", "at s", "for s", "samples", "up x", "up y", "up z", "residual N", "residual Nm"
    table = Table(*map(_right, heads), title="poses", title_justify="left")
    for number, (period, pose) in enumerate(poses):
        left = ["", ""]
        if result is not None:
            residual = result.residuals[number]
            left = [f"{length(residual.force):.3f}", f"{length(residual.torque):.5f}"]
        table.add_row(
            str(number + 1), f"{period.begin_s:.1f}", f"{period.seconds:.1f}", str(pose.samples),
            *(f"{round(part, 2) + 0.0:.2f}" for part in pose.up), *left,
        )  # fmt: skip
    console.print(table)


def show_result(console: Console, result: Identified) -> None:
    """The parameters with their intervals, and notes."""
    heads = "", _right("value"), _right(f"± ({100 * CONFIDENCE:g} %)"), "unit"
    table = Table(*heads, title="payload and bias", title_justify="left")
    table.add_row("mass", f"{result.payload.mass:.4f}", f"{result.mass_interval:.4f}", "kg")
    center, inertia, interval, about = ([1000 * x for x in each] for each in result.payload[1:])
    bias, half = result.bias, result.bias_interval
    rows: list[tuple[str, Sequence[float], Sequence[float], int, str]] = [
        ("center of gravity", center, interval, 2, "mm"),
        ("inertia", inertia, about, 3, "g m²"),
        ("bias force", bias.force, half.force, 3, "N"),
        ("bias torque", bias.torque, half.torque, 5, "Nm"),
    ]
    if result.accelerometer is not None:
        found = result.accelerometer.calibration
        rows.append(("accelerometer offset", found.offset, found.offset_interval, 3, "m/s²"))
        rows.append(("accelerometer scale", found.scale, found.scale_interval, 4, ""))
        rows.append(("accelerometer cross-axis", found.cross_axis, found.cross_axis_interval, 4, ""))
    for name, values, halves, digits, unit in rows:
        names = "xyz" if len(values) == 3 else ELEMENTS if name == "inertia" else CROSS_AXES
        for axis, *numbers in zip(names, values, halves, strict=True):
            table.add_row(f"{name} {axis}", *(f"{number:.{digits}f}" for number in numbers), unit)
    console.print(table)
    console.print(f"residual: {_fit(result.force_fit, 'N')}, {_fit(result.torque_fit, 'Nm')}")
    if result.accelerometer is not None and result.accelerometer.model:
        console.print(f"accelerometer: {result.accelerometer.model}")
    for note in result.notes:
        console.print(f"note: {note}")


def _fit(fit: Fit, unit: str) -> str:
    times = "" if fit.chi_square is None else f", {fit.chi_square**0.5:.1f} times the noise"
    return f"{fit.rms:.3g} {unit} ({fit.verdict}{times})"


def as_json(poses: Poses, rejected: Sequence[str], result: Identified | None, error: str) -> dict[str, Any]:
    """Everything, in SI units; `ok` is whether there is a result."""
    rows: list[dict[str, Any]] = [
        {
            "begin_s": period.begin_s, "seconds": period.seconds, "samples": pose.samples,
            "force": pose.wrench.force, "torque": pose.wrench.torque, "gravity": pose.gravity,
            "force_spread": pose.force_spread, "torque_spread": pose.torque_spread,
        }
        for period, pose in poses
    ]  # fmt: skip
    if result is None:
        return {"ok": False, "error": error, "poses": rows, "rejected": rejected}
    for row, residual in zip(rows, result.residuals, strict=True):
        row["residual_force"], row["residual_torque"] = residual
    fit = result.accelerometer
    return {
        "ok": True,
        "tool_mass": result.payload.mass,
        "tool_mass_interval": result.mass_interval,
        "tool_center_of_gravity": result.payload.center,
        "tool_center_of_gravity_interval": result.payload.center_interval,
        "tool_inertia": result.payload.inertia,
        "tool_inertia_interval": result.payload.inertia_interval,
        "bias": result.bias.values,
        "bias_interval": result.bias_interval.values,
        "confidence": CONFIDENCE,
        "force_rms": result.force_fit.rms,
        "torque_rms": result.torque_fit.rms,
        "force_fit": result.force_fit._asdict(),
        "torque_fit": result.torque_fit._asdict(),
        "accelerometer": fit
        and {**fit.calibration._asdict(), "undetermined": fit.undetermined, "model": fit.model},
        "drift": result.drift and result.drift.values,
        "touched": result.touched,
        "gravity": result.gravity,
        "notes": result.notes,
        "poses": rows,
        "rejected": rejected,
    }


def run(options: argparse.Namespace) -> int:
    for output in filter(None, (options.yaml, options.bota)):
        refuse_existing(output, force=options.force)
    with open_recording(options.path, Asked.of(options)) as recording:
        sensor = choose(recording, options.sensor)
        for remark in recording.remarks:
            _say(f"{options.path} {remark}")
        for row in sensor.history:
            if why := obstacle(row.info.settings, has_tool=True, by_imu=True):
                raise RecordingError(f"{options.path} does not show a tool: {why}; and record again")
        read = AtLastOffset(recording, sensor, options.imu_units)
        motion, stationary = Motion(), StationaryPeriods()
        for table in tables_of(read):
            motion.add(table)
            stationary.add(table)
    stationary.end_stretch()
    periods, rejected = stationary.found, stationary.rejected
    for remark in read.said:
        _say(f"{options.path}: {remark}")
    if len(periods) > MOST_POSES:
        periods = sorted(sorted(periods, key=lambda period: -period.seconds)[:MOST_POSES])
        _say(f"there are more than {MOST_POSES} poses: the longest are used")
    poses, still, error = _solve(periods, options.gravity or STANDARD_GRAVITY)
    try:
        result: Identified | None = _in_motion(motion, sensor, still)
        poses = poses if still else ()
    except CompensationError as refusal:
        result = None
        if error:
            error = f"{error}; or, {'with motion' if still else 'by motion alone'}: {refusal}"
        elif still is not None:
            note = f"the tool's inertia is not identified: {refusal}"
            result = still._replace(notes=(note, *still.notes))
    if result is not None:
        _write_files(options, result, sensor, read.offset)
    if options.json:
        sys.stdout.write(json.dumps(as_json(poses, rejected, result, error), indent=1) + "\n")
    else:
        # A narrower terminal wraps the lines: cells would be cut off.
        console = Console(highlight=False, width=max(_WIDTH, Console().width))
        if poses:
            show_poses(console, poses, result)
        if result is not None:
            show_result(console, result)
    for sentence in rejected if result is None or not options.json else ():
        _say(f"rejected: {sentence}")
    if result is None:
        _say(error)
        return 1
    return 0


def _write_files(
    options: argparse.Namespace, result: Identified, sensor: RecordedSensor, offset: Sequence[float] | None
) -> None:
    if options.bota is not None:
        write_bota(options.bota, result.payload)
        _say(f"written to {options.bota}")
    if options.yaml is not None:
        who = f"{sensor.info.name}, serial number {sensor.info.serial}, from {options.path.name}"
        gravity = None if options.gravity is None else (0.0, 0.0, -options.gravity)
        comment, own = f"{who}\n{summary(result)}", None if offset is None else Wrench.of(offset)
        write_yaml(options.yaml, result, comment, gravity, own, sensor.info.settings)
        _say(f"written to {options.yaml}")
        if offset is None:
            _say(
                f"{options.path} has no offset of the sensor's own, so the bias is right only until that is "
                "changed: record with a newer server"
            )


def _in_motion(motion: Motion, sensor: RecordedSensor, poses: Identified | None) -> Identified:
    """By what the recording has of motion, beside poses or alone; CompensationError."""
    if any(row.info.settings != sensor.info.settings for row in sensor.history):
        raise CompensationError("settings were changed during the recording")
    samples = motion.rows()
    if not len(samples[0]):
        raise CompensationError("no sample can be used")
    alignment, imu = align(sensor.info.settings, sensor.info.rate_hz), imu_position(sensor.info.name)
    turned = turn(*samples, alignment, EXACT, imu)
    del samples  # there may be many
    return identify_in_motion(turned, imu, poses)


def choose(recording: Recording, position: int | None) -> RecordedSensor:
    """The sensor at this position, or the only one; RecordingError."""
    there = {sensor.sensor: sensor for sensor in recording.sensors if sensor.frames}
    if not there:
        raise RecordingError(f"{recording.path} has no samples")
    if position is None and len(there) > 1:
        positions = ", ".join(map(str, there))
        raise RecordingError(f"{recording.path} has several sensors ({positions}): choose one with --sensor")
    sensor = there.get(next(iter(there)) if position is None else position)
    if sensor is None:
        raise RecordingError(f"{recording.path} has no samples of sensor {position}")
    serials = list(dict.fromkeys(row.info.serial for row in sensor.history))
    if len(serials) > 1:
        raise RecordingError(
            f"{recording.path}: sensor {sensor.sensor} was replaced during it (serial numbers "
            f"{', '.join(map(str, serials))}), and each has its own bias: record only one"
        )
    return sensor


def _solve(periods: Sequence[StationaryPeriod], magnitude: float) -> tuple[Poses, Identified | None, str]:
    """The periods that are poses, and the result, or why there is none, or why it needs motion."""
    poses = list[tuple[StationaryPeriod, Pose]]()
    error = f"the sensor is never stationary for {LEAST_S:g} s: hold it still"
    for period in periods:
        try:
            poses.append((period, pose_of(period.means, magnitude=magnitude)))
        except CompensationError as refusal:
            error = str(refusal)
    if not poses:
        return poses, None, error
    try:
        return poses, identify([pose for _, pose in poses]), ""
    except CompensationError as refusal:
        return poses, refusal.result if isinstance(refusal, TooVagueError) else None, str(refusal)
