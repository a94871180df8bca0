"""The bias that is kept across restarts, by the serial number that the server tells."""

from __future__ import annotations

from pathlib import Path

from bridge.compensation.quantities import Payload, Wrench
from bridge.compensation.store import CompensationStore, Stored, StoreError, default_directory
from bridge.compensation_parameters import AUTO


def directory_of(parameter: str) -> Path:
    """The directory that the parameter `bias_directory` means. StoreError if there is none."""
    return default_directory() if parameter == AUTO else expand(parameter, "bias_directory")


def expand(path: str, parameter: str) -> Path:
    """A path that may begin with ~. StoreError if there is no home directory."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise StoreError(f"there is no home directory for {path}: give {parameter} in full") from None


def load(parameter: str, serial: str) -> Stored | None:
    """What was kept of the sensor; None if nothing was. StoreError."""
    return CompensationStore(directory_of(parameter)).load(_number(serial))


def save(parameter: str, serial: str, bias: Wrench, payload: Payload) -> Path:
    """Keep it; the file. StoreError."""
    return CompensationStore(directory_of(parameter)).save(_number(serial), bias, payload)


def _number(serial: str) -> int:
    if not (serial.isascii() and serial.isdigit()):
        raise StoreError(f"the sensor's serial number is {serial!r}, no number: its bias cannot be kept")
    return int(serial)
