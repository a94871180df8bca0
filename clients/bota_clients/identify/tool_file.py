"""A tool's parameters, as `ethercat-identify --yaml` writes them for the ROS 2 node."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bota_clients.errors import RecordingError


@contextlib.contextmanager
def tool_parameters(path: Path) -> Iterator[Mapping[str, Any]]:
    """Read the file; RecordingError, also for what is found wrong with its parameters inside."""
    import yaml  # noqa: PLC0415 - of the extra `dataset`

    try:
        yield yaml.safe_load(path.read_bytes())["/**"]["ros__parameters"]
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from None
    except (yaml.YAMLError, AttributeError, LookupError, TypeError, ValueError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise RecordingError(
            f"{path} does not have a tool's parameters, as ethercat-identify --yaml writes them: {why}"
        ) from None
