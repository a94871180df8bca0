"""A sensor's frames as NumPy arrays, one row per frame, bit-identical to what `bota_ethercat.pdo` decodes.

The offset that the sensor itself adds to every sample (object 0x8000) may change in a recording. The server
reports a change once all six numbers are written, which takes some exchanges: samples shortly before that
have some of them.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from bota_clients.numbers import count
from bota_clients.recording.order import TimeAxis
from bota_clients.recording.reader import RecordedSensor, Recording
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import LAYOUTS, STANDARD_GRAVITY, ImuUnits

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

# The largest process data as a NumPy record, from the table. The smaller begins alike.
_SIZE: Final = max(LAYOUTS)
RECORD: Final = np.dtype([(field.name, "<" + field.type.value) for field in LAYOUTS[_SIZE].fields])
_MAX: Final = (1 << 63) - 1


@dataclass(frozen=True, slots=True)
class Columns:
    """The frames of one sensor in order of arrival; n rows.

    Saturation fields have bit 0 for x, 1 for y, ... as the sensor sends them.
    """

    stamp_ns: Ints  # (n,) CLOCK_REALTIME, ns since 1970
    monotonic_ns: Ints  # (n,) CLOCK_MONOTONIC of the server's machine
    sequence: Ints  # (n,)
    flags: Ints  # (n,) bota_ethercat.framing.DataFlag
    wkc: Ints  # (n,) working counter
    status: Ints  # (n,)
    warnings: Ints  # (n,) bota_ethercat.sensor.warnings_register.WarningFlag
    force: Floats  # (n, 3) N
    torque: Floats  # (n, 3) Nm
    acceleration: Floats  # (n, 3) m/s²
    angular_rate: Floats  # (n, 3) rad/s
    temperature: Floats  # (n,) °C
    orientation: Floats  # (n, 4) x, y, z, w; NaN where the sensor sends none
    force_torque_saturated: Ints  # (n,)
    acceleration_saturated: Ints  # (n,)
    angular_rate_saturated: Ints  # (n,)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def fresh(self) -> Bools:
        """(n,) True where the frame is a new and valid sample."""
        fresh: Bools = (self.flags & NOT_NEW) == 0
        return fresh

    def where(self, mask: Bools) -> Columns:
        """The rows where `mask` is True, for example `columns.where(columns.fresh)`."""
        return Columns(*(getattr(self, name)[mask] for name in self.__slots__))


def columns(frames: Iterable[DataMessage], imu_units: ImuUnits = ImuUnits.G_DPS) -> Columns:
    """The frames of one sensor, for example `recording.frames(sensor=0)`.

    `imu_units` are the units in which the firmware sends acceleration and angular rate.
    """
    heads, data = array("Q"), bytearray()
    for frame in frames:
        heads.extend(frame[:6])
        data += frame.process_data.ljust(_SIZE, b"\0")
    # 64-bit values that do not fit an int64 are no valid times.
    whole_numbers = np.minimum(np.array(heads, np.uint64), _MAX).astype(np.int64)
    sequence, stamp_ns, monotonic_ns, _, flags, wkc = whole_numbers.reshape(-1, 6).T
    table = np.frombuffer(data, RECORD)

    def whole(name: str) -> Ints:
        return table[name].astype(np.int64)

    def vector(name: str, axes: str = "xyz") -> Floats:
        return np.column_stack([table[f"{name}.{axis}"] for axis in axes]).astype(np.float64)

    acceleration, angular_rate = vector("acceleration"), vector("angular_rate")
    if imu_units is ImuUnits.G_DPS:
        acceleration *= STANDARD_GRAVITY
        angular_rate *= math.pi / 180.0
    orientation = vector("orientation", "xyzw")
    orientation[~orientation.any(axis=1)] = math.nan  # all zero: no estimate
    return Columns(
        sequence=sequence, stamp_ns=stamp_ns, monotonic_ns=monotonic_ns, flags=flags, wkc=wkc,
        status=whole("status"), warnings=whole("warnings"), force=vector("force"), torque=vector("torque"),
        acceleration=acceleration, angular_rate=angular_rate,
        temperature=table["temperature"].astype(np.float64), orientation=orientation,
        force_torque_saturated=whole("force_torque_saturated"),
        acceleration_saturated=whole("acceleration_saturated"),
        angular_rate_saturated=whole("angular_rate_saturated"),
    )  # fmt: skip


def joined(parts: Sequence[Columns]) -> Columns:
    return Columns(*(np.concatenate([getattr(part, name) for part in parts]) for name in Columns.__slots__))


def at_last_offset(
    recording: Recording, sensor: RecordedSensor, imu_units: ImuUnits
) -> tuple[Columns, tuple[float, ...] | None, list[str]]:
    """A sensor's columns as if its last offset had been in force all the time, that offset, and remarks.

    On one axis of time, without the samples in which a change was being written, or whose offset is not known
    where that of others is. None: the recording does not say any.
    """
    told = [row.info.offset for row in sensor.offsets if row.info.offset is not None]
    nothing, axis, left_out, is_announced = (0.0,) * 6, TimeAxis(), 0, False
    last = np.array(told[-1] if told else nothing)
    parts, in_doubt, before = list[Columns](), list[tuple[int, int]](), last
    for in_force, batch in axis.batches(recording.batches(sensor.sensor)):
        if told and in_force.info.offset is None:
            left_out, is_announced = left_out + len(batch), True
            continue
        part, shift = columns(batch, imu_units), last - np.array(in_force.info.offset or nothing)
        if parts and (shift != before).any():
            at_ns, doubt_ns = batch[0].monotonic_ns, 0 if is_announced else in_force.doubt_ns
            in_doubt.append((at_ns - doubt_ns, at_ns + in_force.doubt_after_ns))
        is_announced = False
        part.force[:] += shift[:3]
        part.torque[:] += shift[3:]
        parts.append(part)
        before = shift
    found = joined(parts or [columns([])])
    is_sure = np.ones(len(found), bool)
    for begin_ns, end_ns in in_doubt:
        is_sure &= (found.monotonic_ns < begin_ns) | (found.monotonic_ns > end_ns)
    said = axis.said
    if left_out:
        said = [*said, f"{count(left_out, 'frame')} left out: the sensor's own offset was not known"]
    return found.where(is_sure), told[-1] if told else None, said
