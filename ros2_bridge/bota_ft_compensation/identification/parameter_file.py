# SPDX-License-Identifier: Apache-2.0
"""Payload and bias as a YAML file in the form of ROS 2 parameters, to start the node with."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from bota_ethercat.pdo import Vector3
from bota_ethercat.program.new_file import NewFile
from bota_ethercat.settings import SettingValue
from bota_ft_compensation.bias import BiasRamp
from bota_ft_compensation.identification.payload import Identified
from bota_ft_compensation.imu import ImuSource
from bota_ft_compensation.quantities import (
    EXACT,
    IDENTITY,
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    Accelerometer,
    Accuracy,
    Payload,
    Wrench,
)
from bota_ft_compensation.stream import CompensatedStream, Plan

_Row = tuple[str, Sequence[float], str]  # parameter, values, comment


def write_yaml(
    path: Path,
    result: Identified,
    comment: str = "",
    gravity: Vector3 | None = None,
    offset: Wrench | None = None,
    settings: Mapping[str, SettingValue] = MappingProxyType({}),
) -> None:
    """Write what was identified, or replace it, with `comment` on top; FileError if that fails.

    `offset` is the sensor's own, with which the bias was measured; None: not known.

    `gravity` is in the base frame, m/s²; without it the file does not say how the base stands. Where the
    accelerometer was not identified, the file leaves it alone. `settings` are those of the samples.
    """
    rows: list[_Row] = [("bias", result.bias.values, "N, Nm: Fx Fy Fz Mx My Mz, subtracted")]
    if offset is not None:
        rows.append(("sensor_offset", offset.values, "N, Nm: the sensor's own, part of the bias"))
    if gravity is not None:
        rows.append(("gravity", gravity, "m/s², in the base frame"))
    if result.accelerometer is not None:
        units = (
            "m/s², subtracted", "divided by, after that", "m/s², half of 95 %", "half of 95 %",
            "xy xz yx yz zx zy: parts of the second axis, subtracted from the first", "half of 95 %",
        )  # fmt: skip
        parts = zip(result.accelerometer.calibration._asdict().items(), units, strict=True)
        rows += [(f"accelerometer.{name}", part, unit) for (name, part), unit in parts]
    if result.gyroscope != IDENTITY:
        rows.append(("gyroscope_matrix", result.gyroscope, "angular rates are this times what is read"))
        rows.append(("imu_position", result.imu, "m, in the sensor's frame"))
    left = "deviations on each axis: N in any pose, N for each m/s² and rad/s²; Nm likewise"
    accuracy = result.accuracy(settings)
    rows.append(("accuracy.noise", accuracy.noise, "N, Nm: deviations of a sample at SINC 51 with FIR off"))
    rows.append(("accuracy.left", accuracy.left, left))
    write_payload(path, result.payload, comment, rows)


def write_payload(path: Path, payload: Payload, comment: str = "", more: Sequence[_Row] = ()) -> None:
    """Write the tool and `more` rows, or replace it, with `comment` on top; FileError if that fails."""
    rows: list[_Row] = [
        ("tool_center_of_gravity", payload.center, "m, in the sensor's frame"),
        ("tool_center_of_gravity_interval", payload.center_interval, "m, half of 95 %"),
        ("tool_inertia", payload.inertia, "kg m²: xx yy zz xy xz yz, about that"),
        ("tool_inertia_interval", payload.inertia_interval, "kg m², half of 95 %"),
        *more,
    ]
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += ["/**:", "  ros__parameters:", f"    tool_mass: {_number(payload.mass)}  # kg"]
    lines += [f"    {name}: [{', '.join(map(_number, values))}]  # {unit}" for name, values, unit in rows]
    with NewFile(path, force=True) as file:
        file.write("\n".join(lines) + "\n")
        file.finish()


def payload_of(parameters: Mapping[str, Any]) -> Payload:
    """The tool in a node's parameters; LookupError, TypeError or ValueError if there is none."""
    names = "inertia", "center_of_gravity_interval", "inertia_interval"
    rows = zip(names, NO_PAYLOAD[2:], strict=True)
    mass, center = float(parameters["tool_mass"]), tuple(parameters["tool_center_of_gravity"])
    return Payload(mass, center, *(tuple(parameters.get(f"tool_{name}", row)) for name, row in rows))


def stream_of(parameters: Mapping[str, Any]) -> CompensatedStream:
    """What compensates with the tool, the bias and the accelerometer in a node's parameters, by the IMU.

    LookupError, TypeError or ValueError if there is no tool. Without `sensor_offset` a bias is not known.
    """
    payload, bias = payload_of(parameters), Wrench.of(parameters.get("bias", NO_WRENCH.values))
    rows = {name: parameters.get(f"accelerometer.{name}", row) for name, row in EXACT._asdict().items()}
    accelerometer = Accelerometer(**{name: tuple(row) for name, row in rows.items()})
    position, gyroscope = parameters.get("imu_position", ZERO), parameters.get("gyroscope_matrix", IDENTITY)
    source = ImuSource(payload.center, tuple(position), accelerometer, tuple(gyroscope))
    rows = {name: parameters.get(f"accuracy.{name}", row) for name, row in Accuracy()._asdict().items()}
    accuracy = Accuracy(**{name: tuple(row) for name, row in rows.items()})
    plan = Plan(source, payload, BiasRamp(bias), accelerometer, accuracy)
    stream = CompensatedStream(plan, use_saturated=False)
    offset = offset_of(parameters)
    stream.own_offset.begin(bias, offset, is_measured=offset is not None)
    return stream


def offset_of(parameters: Mapping[str, Any]) -> Wrench | None:
    """The sensor's own offset that a bias in a node's parameters goes with; None if they do not say."""
    found = parameters.get("sensor_offset")
    return Wrench.of(found) if found is not None and all(map(math.isfinite, found)) else None


def _number(value: float) -> str:
    # YAML 1.1 takes 1e-05 for text, and ROS a number without a point for an integer.
    return f"{value + 0.0:.9f}"
