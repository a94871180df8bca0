"""Payload and bias as a YAML file in the form of ROS 2 parameters, to start the node with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bota_ethercat.pdo import Vector3
from bota_ethercat.program.new_file import NewFile
from ft_compensation.identification.payload import Identified
from ft_compensation.quantities import Accelerometer, Payload, Wrench


def to_yaml(
    payload: Payload,
    bias: Wrench,
    gravity: Vector3 | None = None,
    comment: str = "",
    node: str = "/**",
    accelerometer: Accelerometer | None = None,
) -> str:
    """The text of a parameter file for `node`; `comment` goes on top of it.

    `gravity` is in the base frame, m/s²; without it the file does not say how the base stands. Without
    `accelerometer` it leaves that one alone.
    """
    rows: list[tuple[str, Sequence[float], str]] = [
        ("tool_center_of_gravity", payload.center, "m, in the sensor's frame"),
        ("bias", bias.values, "N, Nm: Fx Fy Fz Mx My Mz, subtracted"),
    ]
    if gravity is not None:
        rows.append(("gravity", gravity, "m/s², in the base frame"))
    if accelerometer is not None:
        rows.append(("accelerometer.offset", accelerometer.offset, "m/s², subtracted"))
        rows.append(("accelerometer.scale", accelerometer.scale, "divided by, after that"))
        rows.append(("accelerometer.offset_interval", accelerometer.offset_interval, "m/s², half of 95 %"))
        rows.append(("accelerometer.scale_interval", accelerometer.scale_interval, "half of 95 %"))
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += [f"{node}:", "  ros__parameters:", f"    tool_mass: {_number(payload.mass)}  # kg"]
    lines += [f"    {name}: [{', '.join(map(_number, values))}]  # {unit}" for name, values, unit in rows]
    return "\n".join(lines) + "\n"


def write_yaml(path: Path, result: Identified, comment: str = "", gravity: Vector3 | None = None) -> None:
    """Write what was identified, or replace it; `gravity` as for `to_yaml`. FileError if that fails."""
    accelerometer = result.accelerometer.calibration if result.accelerometer else None
    text = to_yaml(result.payload, result.bias, gravity, comment, accelerometer=accelerometer)
    with NewFile(path, force=True) as file:
        file.write(text)
        file.finish()


def _number(value: float) -> str:
    # YAML 1.1 takes 1e-05 for text, and ROS a number without a point for an integer.
    return f"{value + 0.0:.9f}"
