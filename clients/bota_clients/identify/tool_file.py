"""A tool's parameters, as `ethercat-identify --yaml` writes them for the ROS 2 node."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from bota_clients.errors import RecordingError
from bota_ethercat_bridge.parameters.table import PARAMETERS, ParameterError

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
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise RecordingError(
            f"{path} does not have a tool's parameters, as ethercat-identify --yaml writes them: {why}"
        ) from None


def _flat(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """`accelerometer.offset` for `offset` below `accelerometer`, as ROS reads it."""
    for name, value in parameters.items():
        if isinstance(value, dict):
            yield from ((f"{name}.{rest}", each) for rest, each in _flat(value))
        else:
            yield str(name), value
