"""A sensor's frames as NumPy arrays, one row per frame, bit-identical to what `bota_ethercat.pdo` decodes."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import LAYOUTS, STANDARD_GRAVITY, ImuUnits, PdoLayout

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_BASE: Final = min(LAYOUTS)
_AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Columns:
    """The frames of one sensor in order of arrival; n rows.

    Saturation fields have bit 0 for x, 1 for y, ... as the sensor sends them.
    """

    stamp_ns: Ints
    """(n,) CLOCK_REALTIME, ns since 1970"""
    monotonic_ns: Ints
    """(n,) CLOCK_MONOTONIC of the server's machine"""
    sequence: Ints
    """(n,)"""
    flags: Ints
    """(n,) bota_ethercat.framing.DataFlag"""
    wkc: Ints
    """(n,) working counter"""
    status: Ints
    """(n,)"""
    warnings: Ints
    """(n,) bota_ethercat.sensor.warnings_register.WarningFlag"""
    force: Floats
    """(n, 3) N"""
    torque: Floats
    """(n, 3) Nm"""
    acceleration: Floats
    """(n, 3) m/s²"""
    angular_rate: Floats
    """(n, 3) rad/s"""
    temperature: Floats
    """(n,) °C"""
    orientation: Floats
    """(n, 4) x, y, z, w; NaN where the sensor sends none"""
    force_torque_saturated: Ints
    """(n,)"""
    acceleration_saturated: Ints
    """(n,)"""
    angular_rate_saturated: Ints
    """(n,)"""

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def fresh(self) -> npt.NDArray[np.bool_]:
        """(n,) True where the frame is a new and valid sample."""
        fresh: npt.NDArray[np.bool_] = (self.flags & NOT_NEW) == 0
        return fresh

    def where(self, mask: npt.NDArray[np.bool_]) -> Columns:
        """The rows where `mask` is True, for example `columns.where(columns.fresh)`."""
        return Columns(*(getattr(self, name)[mask] for name in self.__slots__))


class FrameSource(Protocol):
    """A source of frames: a `bota_clients.recording.reader.Recording`, or frames received live."""

    def frames(self, sensor: int | None = None) -> Iterable[DataMessage]:
        """The frames of the sensor at this position, or of all, in the order in which they came."""


def columns(recording: FrameSource, sensor: int = 0, imu_units: ImuUnits = ImuUnits.G_DPS) -> Columns:
    """All frames of the sensor at this position. DamagedError as `Recording.frames`.

    `imu_units` are the units in which the firmware sends acceleration and angular rate.
    """
    heads = array("q")
    data: dict[int, list[bytes]] = {}
    rows: dict[int, list[int]] = {}
    count = 0
    for frame in recording.frames(sensor):
        # 64-bit values that do not fit an int64 are no valid times.
        heads.extend([min(value, (1 << 63) - 1) for value in frame[:6]])
        size = len(frame.process_data)
        data.setdefault(size, []).append(frame.process_data)
        rows.setdefault(size, []).append(count)
        count += 1
    head = np.array(heads, dtype=np.int64).reshape(count, 6)
    parts = {size: np.frombuffer(b"".join(part), _dtype(LAYOUTS[size])) for size, part in data.items()}
    merged = _Merged(count, parts, rows)
    acceleration, angular_rate = merged.vector("acceleration"), merged.vector("angular_rate")
    if imu_units is ImuUnits.G_DPS:
        acceleration *= STANDARD_GRAVITY
        angular_rate *= math.pi / 180.0
    orientation = merged.orientation()
    return Columns(
        sequence=head[:, 0], stamp_ns=head[:, 1], monotonic_ns=head[:, 2], flags=head[:, 4], wkc=head[:, 5],
        status=merged.integer("status"), warnings=merged.integer("warnings"),
        force=merged.vector("force"), torque=merged.vector("torque"),
        acceleration=acceleration, angular_rate=angular_rate,
        temperature=merged.number("temperature"), orientation=orientation,
        force_torque_saturated=merged.integer("force_torque_saturated"),
        acceleration_saturated=merged.integer("acceleration_saturated"),
        angular_rate_saturated=merged.integer("angular_rate_saturated"),
    )  # fmt: skip


def _dtype(layout: PdoLayout) -> np.dtype[Any]:
    """The process data as a NumPy record, from the table."""
    return np.dtype([(field.name, "<" + field.type.value) for field in layout.fields])


class _Merged:
    """Fields of frames whose process data may have either size, because a sensor can be replaced."""

    def __init__(self, count: int, parts: dict[int, npt.NDArray[Any]], rows: dict[int, list[int]]) -> None:
        self._count = count
        self._parts = parts
        self._rows = {size: np.array(positions, dtype=np.int64) for size, positions in rows.items()}

    def integer(self, name: str) -> Ints:
        merged = np.zeros(self._count, np.int64)
        for size, part in self._parts.items():
            merged[self._rows[size]] = part[name]
        return merged

    def number(self, name: str, absent: float = math.nan) -> Floats:
        merged = np.full(self._count, absent)
        for size, part in self._parts.items():
            if name in (part.dtype.names or ()):
                merged[self._rows[size]] = part[name]
        return merged

    def vector(self, name: str, axes: tuple[str, ...] = _AXES) -> Floats:
        return np.column_stack([self.number(f"{name}.{axis}") for axis in axes])

    def orientation(self) -> Floats:
        merged = self.vector("orientation", (*_AXES, "w"))
        merged[~merged.any(axis=1)] = math.nan  # all zero: no estimate
        return merged
