"""Payload and bias as a YAML file in the form of ROS 2 parameters.

Only this form is read: the parameters that are written here, with inline or block lists. Everything else in
a file, such as parameters of other names, is passed over; ROS reads the same file with its own parser.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from bridge.compensation.payload import Identified
from bridge.compensation.quantities import (
    DEFAULT_GRAVITY,
    NO_PAYLOAD,
    NO_WRENCH,
    ZERO,
    CompensationError,
    Payload,
    Wrench,
    vector,
)
from protocol.pdo import Vector3

_LARGEST_FILE: Final = 1 << 20
_NAMES: Final = ("tool_mass", "tool_center_of_gravity", "bias", "gravity")
_ENTRY: Final = re.compile(r"^(\s*)([A-Za-z_][\w./]*|/\*\*|/[\w/]*)\s*:\s*(.*)$")
_ITEM: Final = re.compile(r"^\s*-\s+(\S.*)$")


class ParameterFileError(CompensationError):
    """The file cannot be read or written, or is not understood; the text is one sentence that names it."""


class CompensationParameters(NamedTuple):
    """The four parameters of the node that say what to subtract."""

    payload: Payload = NO_PAYLOAD
    bias: Wrench = NO_WRENCH
    gravity: Vector3 = DEFAULT_GRAVITY
    """In the base frame, m/s²."""


def parameters_of(result: Identified) -> CompensationParameters:
    """What the node is to be given after an identification."""
    return CompensationParameters(result.payload, result.bias, (0.0, 0.0, -result.gravity))


def to_yaml(parameters: CompensationParameters, comment: str = "", node: str = "/**") -> str:
    """The text of a parameter file for `node`; `comment` goes on top of it."""
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += [f"{node}:", "  ros__parameters:"]
    payload, bias, gravity = parameters
    lines.append(f"    tool_mass: {_number(payload.mass)}  # kg")
    for name, values, unit in (
        ("tool_center_of_gravity", payload.centre, "m, in the sensor's frame"),
        ("bias", bias.values, "N, Nm: Fx Fy Fz Mx My Mz, subtracted"),
        ("gravity", gravity, "m/s², in the base frame"),
    ):
        lines.append(f"    {name}: [{', '.join(map(_number, values))}]  # {unit}")
    return "\n".join(lines) + "\n"


def from_yaml(text: str) -> CompensationParameters:
    """Read it back; a parameter that is not there keeps its default. ParameterFileError if it is no good."""
    found: dict[str, list[str]] = {}
    for number, name, values in _entries(text):
        if name in found:
            raise ParameterFileError(f"line {number} gives {name} a second time")
        found[name] = values
    if not found:
        raise ParameterFileError(f"there is none of {', '.join(_NAMES)} in it")
    try:
        mass = found.get("tool_mass", ["0.0"])
        if len(mass) != 1:
            raise ValueError("tool_mass is one number")
        payload = Payload.of(mass[0], found.get("tool_center_of_gravity", ZERO))
        bias = Wrench.of(found.get("bias", NO_WRENCH.values))
        gravity = vector(found.get("gravity", DEFAULT_GRAVITY), "gravity")
    except ValueError as error:
        raise ParameterFileError(str(error)) from None
    return CompensationParameters(payload, bias, gravity)


def write_yaml(path: Path, parameters: CompensationParameters, comment: str = "") -> None:
    """Write a file. ParameterFileError if that fails."""
    try:
        path.write_text(to_yaml(parameters, comment), encoding="utf-8")
    except OSError as error:
        raise ParameterFileError(f"{path} cannot be written: {error.strerror or error}") from None


def read_yaml(path: Path) -> CompensationParameters:
    """Read a file. ParameterFileError, a sentence that names it, if that fails."""
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_FILE + 1)
        if len(data) > _LARGEST_FILE:
            raise ParameterFileError("it is too large for a parameter file")
        return from_yaml(data.decode())
    except OSError as error:
        raise ParameterFileError(f"{path} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise ParameterFileError(f"{path} is not used: it is not text") from None
    except ParameterFileError as error:
        raise ParameterFileError(f"{path} is not used: {error}") from None


def _number(value: float) -> str:
    # YAML 1.1 takes 1e-05 for text, and ROS a number without a point for an integer.
    return f"{value + 0.0:.9f}"


def _entries(text: str) -> Iterator[tuple[int, str, list[str]]]:
    """Line number, name and values of the parameters that are ours."""
    lines = [re.sub(r"(^|\s)#.*", "", line).rstrip() for line in text.splitlines()]
    for place, line in enumerate(lines):
        entry = _ENTRY.match(line)
        if entry is None or entry[2] not in _NAMES:
            continue
        value = entry[3].strip()
        if value.startswith("["):
            if not value.endswith("]"):
                raise ParameterFileError(f"line {place + 1} does not close its list")
            yield place + 1, entry[2], [part.strip() for part in value[1:-1].split(",")]
        elif value:
            yield place + 1, entry[2], [value]
        else:
            yield place + 1, entry[2], list(_items(lines[place + 1 :]))


def _items(lines: list[str]) -> Iterator[str]:
    for line in lines:
        if not line:
            continue
        item = _ITEM.match(line)
        if item is None:
            return
        yield item[1]
