"""A sensor's frames as NumPy arrays, one row per frame, bit-identical to what `bota_ethercat.pdo` decodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from bota_clients.recording import file_format
from bota_clients.recording.mcap_file import HEAD, HEADS, RECORD_HEAD, Rows
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.pdo import LAYOUTS, STANDARD_GRAVITY, ImuUnits

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Whole = npt.NDArray[Any]  # unsigned integers of the size that they are sent in
Table = npt.NDArray[np.void]  # (n,) of one of RECORDS

_MAX: Final = (1 << 63) - 1
_GAP: Final = int(DataFlag.GAP)
REGISTERS: Final = (
    "force_torque_saturated", "acceleration_saturated", "angular_rate_saturated", "warnings", "status",
)  # fmt: skip
_TIMES: Final = ("sequence", "stamp_ns", "monotonic_ns")
_WHOLE: Final = ("flags", "wkc", *REGISTERS)
_HEADS: Final = HEAD - RECORD_HEAD + file_format.FRAME_SIZE  # of the length of a record
_VECTORS: Final = {"force": 3, "torque": 3, "acceleration": 3, "angular_rate": 3, "orientation": 4}
_FRAME: Final = [
    ("sequence", "<u8"), ("stamp_ns", "<u8"), ("monotonic_ns", "<u8"), ("sensor", "u1"), ("flags", "u1"),
    ("wkc", "<u2"),
]  # fmt: skip


def _fields(size: int) -> list[tuple[str, str, tuple[int, ...]]]:
    """Of this much process data, vectors as one."""
    found = ((each.name.partition("."), "<" + each.type.value) for each in LAYOUTS[size].fields)
    return [
        (name, kind, (_VECTORS[name],) if axis else ())
        for (name, _, axis), kind in found
        if axis in ("", "x")
    ]


# By size of the process data, a frame as a message in a chunk: heads, frame and fields.
RECORDS: Final = {
    size: np.dtype([*HEADS, ("cdr", "<u4"), *_FRAME, ("size", "<u4"), *_fields(size)])
    for size in sorted(LAYOUTS)
}
_SIZES: Final = np.vstack([*LAYOUTS]).astype("<u4")
RECORD: Final = RECORDS[max(LAYOUTS)]  # the smaller begins alike
_ARRIVED: Final = np.dtype([*_FRAME, ("process_data", f"V{max(LAYOUTS)}")])  # fields of a `DataMessage`
_DECODED: Final = np.dtype([*_FRAME, *_fields(max(LAYOUTS))])


def table_of(parts: Sequence[Rows], of: npt.NDArray[Any]) -> Table:
    """The frames in these records, `of` which sensor by channel; RecordingError at the first that is none."""
    widest = max(part.shape[1] for part in parts)
    record = next((each for each in RECORDS.values() if each.itemsize >= widest), RECORD)
    width = record.itemsize
    if any(part.shape[1] != width for part in parts):
        parts = [np.pad(part[:, :width], ((0, 0), (0, max(width - part.shape[1], 0)))) for part in parts]
    table: Table = np.frombuffer(b"".join(part.data for part in parts), record)  # copied at once
    sizes, sensors = table["size"], of.take(table["channel"])
    fits = (table["cdr"] == file_format.CDR_NUMBER) & (table["sensor"] == sensors)
    fits &= table["length"] == sizes + np.uint64(_HEADS)
    fits &= (sizes == _SIZES).any(axis=0)
    if not fits.all():
        row = int(fits.argmin())
        length = int(table["length"][row]) - (HEAD - RECORD_HEAD)
        body = table[row].tobytes()[HEAD:].ljust(length, b"\0")[:length]
        file_format.unpack_frame(body, int(sensors[row]))
    return table


def frames_of(table: Table) -> Iterator[DataMessage]:
    for row in table:
        body = row.tobytes()[HEAD : RECORD_HEAD + int(row["length"])]
        yield file_format.unpack_frame(body, int(row["sensor"]))


@dataclass(frozen=True, slots=True)
class Columns:
    """The frames of one sensor in order of arrival; n rows.

    Saturation fields have bit 0 for x, 1 for y, ... as the sensor sends them.
    """

    stamp_ns: Ints  # (n,) CLOCK_REALTIME, ns since 1970
    monotonic_ns: Ints  # (n,) CLOCK_MONOTONIC of the server's machine
    sequence: Ints  # (n,)
    flags: Whole  # (n,) bota_ethercat.framing.DataFlag
    wkc: Whole  # (n,) working counter
    status: Whole  # (n,)
    warnings: Whole  # (n,) bota_ethercat.sensor.warnings_register.WarningFlag
    force: Floats  # (n, 3) N
    torque: Floats  # (n, 3) Nm
    acceleration: Floats  # (n, 3) m/s²
    angular_rate: Floats  # (n, 3) rad/s
    temperature: Floats  # (n,) °C
    orientation: Floats  # (n, 4) x, y, z, w; NaN where the sensor sends none
    force_torque_saturated: Whole  # (n,)
    acceleration_saturated: Whole  # (n,)
    angular_rate_saturated: Whole  # (n,)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def fresh(self) -> Bools:
        """(n,) True where the frame is a new and valid sample."""
        fresh: Bools = (self.flags & NOT_NEW) == 0
        return fresh

    def where(self, mask: Bools | slice) -> Columns:
        """The rows where `mask` is True, for example `columns.where(columns.fresh)`."""
        return Columns(*(getattr(self, name)[mask] for name in self.__slots__))

    @classmethod
    def empty(cls, count: int) -> Columns:
        """So many rows, to be filled."""
        kinds = {name: RECORD[name] for name in _WHOLE} | dict.fromkeys(_TIMES, np.dtype(np.int64))
        shapes = {name: (count, axes) for name, axes in _VECTORS.items()}
        return cls(**{name: np.empty(shapes.get(name, count), kinds.get(name)) for name in cls.__slots__})

    def fill(self, table: Table, imu_units: ImuUnits) -> None:
        """Take the frames of as many rows."""
        for name in _WHOLE:
            getattr(self, name)[:] = table[name]
        for name in _TIMES:  # 64-bit values that do not fit an int64 are no valid times
            getattr(self, name)[:] = np.minimum(table[name], _MAX)
        self.temperature[:] = table["temperature"]
        self.orientation[:] = 0.0
        for name in _VECTORS.keys() & (table.dtype.names or ()):
            getattr(self, name)[:] = table[name]
        self.orientation[~self.orientation.any(axis=1)] = math.nan  # all zero: no estimate
        if imu_units is ImuUnits.G_DPS:
            np.multiply(self.acceleration, STANDARD_GRAVITY, out=self.acceleration)
            np.multiply(self.angular_rate, math.pi / 180.0, out=self.angular_rate)

    @classmethod
    def of(cls, table: Table, imu_units: ImuUnits = ImuUnits.G_DPS) -> Columns:
        """`imu_units` are the units in which the firmware sends acceleration and angular rate."""
        found = cls.empty(len(table))
        found.fill(table, imu_units)
        return found


def columns(frames: Iterable[DataMessage], imu_units: ImuUnits = ImuUnits.G_DPS) -> Columns:
    """Frames of one sensor that are no recording's."""
    return Columns.of(np.array(list(frames), _ARRIVED).view(_DECODED), imu_units)


def joined(parts: Sequence[Columns]) -> Columns:
    return Columns(*(np.concatenate([getattr(part, name) for part in parts]) for name in Columns.__slots__))


class NewSamples:
    """Finds the frames that are new and valid samples; a GAP of others is also the next sample's."""

    def __init__(self) -> None:
        self._gaps = set[int]()  # sensors that had one since their latest sample

    def among(self, flags: Whole, sensor: int = 0) -> tuple[Bools, Whole]:
        """(n,) which of the next frames of a sensor are, and the flags of all with those GAPs."""
        is_new, is_gap = (flags & NOT_NEW) == 0, (flags & _GAP) != 0
        if is_new.all() and sensor not in self._gaps:
            return is_new, flags
        gaps = np.append(int(sensor in self._gaps), is_gap).cumsum()
        at = np.flatnonzero(is_new)
        told, found = gaps[at + 1], flags.copy()
        found[at[np.diff(told, prepend=0) > 0]] |= _GAP
        self._gaps.discard(sensor)
        if gaps[-1] > told[-1:].max(initial=0):
            self._gaps.add(sensor)
        return is_new, found
