"""A tool in a file: parameters of the ROS 2 node, as `ethercat-identify --yaml` writes them, and the file of
Bota's `bota-payload-utils`, which is written, and turned into these parameters and back.

Its estimator writes such a file and its compensator reads it, by runs of version 1.0.3, without the `bias` in
it. There the inertia is about the origin of the wrench, here about the center of gravity.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.program import say
from bota_ethercat.program.new_file import NewFile, refuse_existing
from bota_ethercat_bridge.parameters.table import PARAMETERS, ParameterError
from bota_ft_compensation.identification.inertia import possible_inertia
from bota_ft_compensation.identification.parameter_file import payload_of, write_payload
from bota_ft_compensation.quantities import (
    ELEMENTS,
    CompensationError,
    Payload,
    likely_inertia,
    vector,
)

_say = partial(say, "ethercat-identify")
_ROWS: Final = {row.name: row for row in PARAMETERS}


@contextlib.contextmanager
def tool_parameters(path: Path) -> Iterator[Mapping[str, Any]]:
    """Read the file, of whatever node; RecordingError, also for what is found wrong with it inside."""
    import yaml  # noqa: PLC0415 - of the extra `dataset`

    try:
        read = yaml.safe_load(path.read_bytes())
        nodes = read.values() if isinstance(read, dict) else ()
        given = [
            node["ros__parameters"] for node in nodes if isinstance(node, dict) and "ros__parameters" in node
        ]
        if len(given) != 1 or not isinstance(given[0], dict):
            raise ValueError("it has no ros__parameters, or those of several nodes")
        flat = _flat(given[0])
        yield {name: _ROWS[name].check(value) if name in _ROWS else value for name, value in flat}
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from None
    except (yaml.YAMLError, AttributeError, LookupError, ParameterError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{path} does not have a tool's parameters, as ethercat-identify --yaml writes them: "
            f"{_why(error)}"
        ) from None


def _why(error: Exception) -> str:
    """In one line."""
    return f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())


def _flat(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """`accelerometer.offset` for `offset` below `accelerometer`, as ROS reads it."""
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from ((f"{name}.{rest}", each) for rest, each in _flat(value))
        else:
            yield str(name), value


def write_bota(path: Path, payload: Payload) -> None:
    """Write it, or replace it, with compensation of motion on if the inertia is known; FileError."""
    elements = np.array(payload.inertia) + _of_the_center(payload)
    properties = {
        "mass": payload.mass,
        "com": dict(zip("xyz", payload.center, strict=True)),
        "inertia": dict(zip((f"I{name}" for name in ELEMENTS), elements.tolist(), strict=True)),
    }
    config = {"payload_properties": properties, "enable_dynamic_compensation": any(payload.inertia)}
    with NewFile(path, force=True) as file:
        file.write(json.dumps({"payload_compensator_config": config}, indent=2) + "\n")
        file.finish()


def read_bota(path: Path) -> tuple[Payload, str]:
    """The tool, and why it has no inertia or ""; RecordingError if there is no mass and center.

    Nothing tells how good a tensor is: its intervals are as wide as those of an unknown one.
    """
    try:
        found: Any = json.loads(path.read_bytes())["payload_compensator_config"]["payload_properties"]
        mass, center = float(found["mass"]), vector([found["com"][axis] for axis in "xyz"], "com")
        elements = [float(found["inertia"][f"I{name}"]) for name in ELEMENTS]
        if not all(map(math.isfinite, (mass, *elements))):
            raise ValueError("mass and inertia are finite numbers")
    except (OSError, LookupError, TypeError, ValueError) as error:
        said = f"{path} is no configuration of Bota's payload compensator: {_why(error)}"
        raise RecordingError(said) from None
    if mass <= 0.0:
        raise RecordingError(
            f"{path} has a mass of {mass:g} kg, which no tool has: force or acceleration had another sign "
            "when it was estimated; use ethercat-identify with a recording"
        )
    payload = Payload(mass, center)
    half = likely_inertia(payload)[1]
    try:
        inertia = possible_inertia(np.array(elements) - _of_the_center(payload), np.array(half))
    except CompensationError as refusal:
        return payload, str(refusal)
    return payload._replace(inertia=tuple(inertia.tolist()), inertia_interval=half), ""


def _of_the_center(payload: Payload) -> np.ndarray[Any, np.dtype[np.float64]]:
    """kg m² (6,): by how much the inertia about the origin is more than that about the center of gravity."""
    x, y, z = payload.center
    second = np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])
    return payload.mass * second


def run(options: argparse.Namespace) -> int:
    """From a .json of Bota's to --yaml, or from such a .yaml to --bota."""
    path: Path = options.path
    is_bota = path.suffix == ".json"
    output, name = (options.yaml, "yaml") if is_bota else (options.bota, "bota")
    if output is None:
        raise RecordingError(f"{path} is a tool already: give --{name} OUT to convert it")
    refuse_existing(output, force=options.force)
    if is_bota:
        payload, why = read_bota(path)
        write_payload(output, payload, f"from {path.name}, Bota's: tare once, a bias is not taken from it")
        if why:
            _say(f"the inertia in {path} is left out: {why}")
    else:
        with tool_parameters(path) as found:
            payload = payload_of(found)
            if not 0.0 < payload.mass < np.inf:
                raise ValueError(f"tool_mass is {payload.mass:g}")
        write_bota(output, payload)
    _say(f"written to {output}")
    return 0
