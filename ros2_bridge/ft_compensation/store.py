"""Bias and payload kept across restarts: one small JSON file for each sensor, by its serial number.

A file is replaced whole (written beside, flushed to disk, renamed), so a crash leaves the old one or the new
one.
"""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_ethercat.errors import FileError
from bota_ethercat.pdo import Vector3
from bota_ethercat.program.new_file import NewFile
from ft_compensation.quantities import CompensationError, Payload, Wrench, vector

_FORMAT: Final = "bota-ethercat-bridge compensation"
_VERSION: Final = 1
_LARGEST_FILE: Final = 65536
_FOLDER: Final = "bota-ethercat-bridge"


class StoreError(CompensationError):
    """The file cannot be read or written, or is not one of ours; the text is one sentence that names it."""


class Stored(NamedTuple):
    """What was kept of one sensor."""

    bias: Wrench
    payload: Payload | None
    saved: str  # when, ISO 8601 in UTC
    # The sensor's own offset, which the bias was taken with; None if not known or not needed.
    offset: Wrench | None = None
    # In the sensor's frame during the tare, m/s²; None if not known. Zero: it does not matter.
    specific_force: Vector3 | None = None


def default_directory() -> Path:
    """$XDG_STATE_HOME/bota-ethercat-bridge, or ~/.local/state/bota-ethercat-bridge."""
    state = os.environ.get("XDG_STATE_HOME", "")
    # The specification says that a relative path is to be ignored.
    if Path(state).is_absolute():
        return Path(state) / _FOLDER
    try:
        return Path.home() / ".local" / "state" / _FOLDER
    except RuntimeError:
        raise StoreError("there is no home directory to keep the bias in: set XDG_STATE_HOME") from None


class CompensationStore:
    """The files of one directory."""

    def __init__(self, directory: Path) -> None:
        """It is made when something is saved."""
        self.directory = directory

    def path(self, serial: int) -> Path:
        """The file of the sensor with this serial number."""
        return self.directory / f"sensor-{int(serial)}.json"

    def save(
        self,
        serial: int,
        bias: Wrench,
        payload: Payload | None = None,
        offset: Wrench | None = None,
        specific_force: Vector3 | None = None,
    ) -> Path:
        """Keep them, in place of what was kept before; returns the file. StoreError if that fails."""
        path = self.path(serial)
        content = {
            "format": _FORMAT,
            "version": _VERSION,
            "serial": int(serial),
            "saved": datetime.now(UTC).isoformat(timespec="seconds"),
            "bias": Wrench.of(bias.values).values,
            "tool_mass": payload and payload.mass,
            "tool_center_of_gravity": payload and payload.center,
            "sensor_offset": offset and offset.values,
            "specific_force": specific_force,
        }
        content = {name: value for name, value in content.items() if value is not None}
        try:
            self.directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            with NewFile(path, force=True, mode=0o600) as file:
                file.write(json.dumps(content, indent=1, allow_nan=False) + "\n")
                file.finish()
        except FileError as error:
            raise StoreError(str(error)) from None
        except OSError as error:
            raise StoreError(f"{path} cannot be written: {error.strerror or error}") from None
        return path

    def load(self, serial: int) -> Stored | None:
        """What was kept of this sensor; None if nothing was. StoreError if the file is no good."""
        path = self.path(serial)
        try:
            with path.open("rb") as file:
                data = file.read(_LARGEST_FILE + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StoreError(f"{path} cannot be read: {error.strerror or error}") from None
        try:
            return _parse(data, serial)
        except (ValueError, RecursionError) as error:
            reason = str(error) if isinstance(error, _ContentError) else "it is not whole"
            raise StoreError(
                f"{path} is not used: {reason}; take the bias again or remove the file"
            ) from None


class _ContentError(ValueError):
    """What is wrong with a file that is JSON."""


def _parse(data: bytes, serial: int) -> Stored:
    if len(data) > _LARGEST_FILE:
        raise _ContentError("it is too large to be a file of this program")
    content: Any = json.loads(data.decode())
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise _ContentError("another program wrote it")
    if content.get("version") != _VERSION:
        raise _ContentError(f"it has version {content.get('version')!r:.20}, this program reads {_VERSION}")
    if content.get("serial") != serial:
        raise _ContentError(f"it belongs to sensor {content.get('serial')!r:.20}, not {serial}")
    try:
        bias = Wrench.of(content.get("bias"))
        payload = offset = felt = None
        if "sensor_offset" in content:
            offset = Wrench.of(content["sensor_offset"])
        if "tool_mass" in content:
            payload = Payload.of(content["tool_mass"], content.get("tool_center_of_gravity"))
        if "specific_force" in content:
            felt = vector(content["specific_force"], "a specific force")
    except ValueError as error:
        raise _ContentError(str(error)) from None
    return Stored(bias, payload, str(content.get("saved", ""))[:40], offset, felt)
