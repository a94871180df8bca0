# SPDX-License-Identifier: Apache-2.0
"""The sensor's process data: one table of fields, and everything that follows from it.

Object 0x6000, mapped as 61 bytes; newer firmware maps an orientation quaternion after it (77 bytes, as in the
dictionary of a Rokubi). All values are little-endian and packed. Offsets, sizes and struct formats follow
from the rows, here and nowhere else.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from enum import Enum
from operator import itemgetter
from typing import Any, Final, NamedTuple

from bota_ethercat.errors import PdoSizeError

STANDARD_GRAVITY: Final = 9.80665  # m/s² in one g, as Bota's own drivers convert it

AXES: Final = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")  # of a wrench: N, Nm
INPUT_OBJECT: Final = 0x6000  # the object whose sub-indices the TxPDO maps


class PdoType(Enum):
    """An EtherCAT base data type as mapped into a PDO."""

    USINT = "B"
    UINT = "H"
    UDINT = "I"
    REAL = "f"

    @property
    def size(self) -> int:
        """Size in bytes."""
        return struct.calcsize("<" + self.value)


class PdoField(NamedTuple):
    """One mapped object entry."""

    subindex: int  # Sub-index of 0x6000. There is no 0x03.
    name: str  # field name; a vector's parts are `vector.x`, `vector.y`, ...
    type: PdoType
    unit: str  # unit on the wire, before any conversion
    title: str  # its name in the sensor's object dictionary


_U8, _U16, _U32, _F32 = PdoType.USINT, PdoType.UINT, PdoType.UDINT, PdoType.REAL

PDO_FIELDS: Final[tuple[PdoField, ...]] = (
    PdoField(0x01, "status", _U8, "", "Status"),
    PdoField(0x02, "warnings", _U32, "", "Warnings Errors Fatal"),
    PdoField(0x04, "force.x", _F32, "N", "Force x"),
    PdoField(0x05, "force.y", _F32, "N", "Force y"),
    PdoField(0x06, "force.z", _F32, "N", "Force z"),
    PdoField(0x07, "torque.x", _F32, "Nm", "Torque x"),
    PdoField(0x08, "torque.y", _F32, "Nm", "Torque y"),
    PdoField(0x09, "torque.z", _F32, "Nm", "Torque z"),
    PdoField(0x0A, "force_torque_saturated", _U16, "", "Force Torque Saturated"),
    PdoField(0x0B, "acceleration.x", _F32, "g", "Acceleration x"),
    PdoField(0x0C, "acceleration.y", _F32, "g", "Acceleration y"),
    PdoField(0x0D, "acceleration.z", _F32, "g", "Acceleration z"),
    PdoField(0x0E, "acceleration_saturated", _U8, "", "Acceleration Saturated"),
    PdoField(0x0F, "angular_rate.x", _F32, "deg/s", "Angular Velocities x"),
    PdoField(0x10, "angular_rate.y", _F32, "deg/s", "Angular Velocities y"),
    PdoField(0x11, "angular_rate.z", _F32, "deg/s", "Angular Velocities z"),
    PdoField(0x12, "angular_rate_saturated", _U8, "", "Angular Velocities Saturated"),
    PdoField(0x13, "temperature", _F32, "degC", "Temperature"),
    # Mapped by newer firmware only.
    PdoField(0x14, "orientation.x", _F32, "", "Orientation x"),
    PdoField(0x15, "orientation.y", _F32, "", "Orientation y"),
    PdoField(0x16, "orientation.z", _F32, "", "Orientation z"),
    PdoField(0x17, "orientation.w", _F32, "", "Orientation w"),
)

_BASE_FIELD_COUNT: Final = next(i for i, f in enumerate(PDO_FIELDS) if f.name.startswith("orientation"))


class ImuUnits(Enum):
    """Units in which the sensor's firmware sends acceleration and angular rate."""

    G_DPS = "g_dps"
    SI = "si"


class PdoLayout:
    """One size of process data: its fields, their offsets and a compiled struct.

    Attributes:
        fields: the mapped fields, in order.
        offsets: byte offset of each field, by name.
        struct: little-endian `struct.Struct` of all fields.
        size: bytes.
        reals: the same with the REAL fields only.
        has_orientation: whether the quaternion is mapped.
    """

    def __init__(self, fields: tuple[PdoField, ...]) -> None:
        self.fields = fields
        self.struct = struct.Struct("<" + "".join(field.type.value for field in fields))
        self.size = self.struct.size
        self.reals = struct.Struct(
            "<" + "".join("f" if f.type is PdoType.REAL else f"{f.type.size}x" for f in fields)
        )
        self.offsets: dict[str, int] = {}
        offset = 0
        for field in fields:
            self.offsets[field.name] = offset
            offset += field.type.size
        self.has_orientation = "orientation.w" in self.offsets

    def index(self, name: str) -> int:
        """Position of the field `name` in the tuple that `struct.unpack` gives."""
        return next(i for i, field in enumerate(self.fields) if field.name == name)


LAYOUTS: Final[dict[int, PdoLayout]] = {
    layout.size: layout for layout in (PdoLayout(PDO_FIELDS[:_BASE_FIELD_COUNT]), PdoLayout(PDO_FIELDS))
}
"""Layouts of Gen-0 sensors by size: 61 bytes, and 77 with orientation."""


def layout_for(size: int) -> PdoLayout:
    """Return the layout of `size` bytes of process data; PdoSizeError if there is none."""
    if size not in LAYOUTS:
        known = " or ".join(map(str, LAYOUTS))
        raise PdoSizeError(f"process data of {size} bytes: a Bota Gen-0 sensor maps {known}")
    return LAYOUTS[size]


def is_finite(process_data: bytes) -> bool:
    """Whether every measured value is a finite number; True for process data of unknown size."""
    layout = LAYOUTS.get(len(process_data))
    # An infinity or a NaN survives every sum, and a sum of float32 values cannot overflow a double.
    return layout is None or math.isfinite(sum(layout.reals.unpack(process_data)))


Vector3 = tuple[float, float, float]
Values = tuple[Any, ...]  # the fields of process data in their order, as unpacked


def _part(first: str, last: str) -> slice:
    """Where the fields from `first` to `last` are in `Values`."""
    index = LAYOUTS[max(LAYOUTS)].index
    return slice(index(first), index(last) + 1)


WRENCH: Final = _part("force.x", "torque.z")
MOTION: Final = _part("acceleration.x", "angular_rate.z")  # with the flag between the two
TEMPERATURE: Final = _part("temperature", "temperature")
ORIENTATION: Final = _part("orientation.x", "orientation.w")  # () if it is not mapped


class Sample(NamedTuple):
    """One decoded sample, everything in SI units and in the sensor's own frame.

    `temperature` is the exception that REP 103 makes: degrees Celsius. `orientation` is the sensor's own
    estimate as x, y, z, w, or None if it maps none or all four are zero (no estimate).
    """

    force: Vector3  # N
    torque: Vector3  # Nm
    acceleration: Vector3  # m/s²; a stationary sensor measures +g along the axis that points up
    angular_rate: Vector3  # rad/s
    temperature: float  # °C
    orientation: tuple[float, float, float, float] | None
    status: int
    warnings: int  # the warnings register; see `bota_ethercat.sensor.warnings_register`
    force_torque_saturated: int
    acceleration_saturated: int
    angular_rate_saturated: int

    @property
    def array(self) -> list[float]:
        """The twelve values of `/sensone_sensor_data`: Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz."""
        return [*self.force, *self.torque, *self.acceleration, *self.angular_rate]

    @property
    def is_finite(self) -> bool:
        """Whether every measured value is a finite number."""
        # An infinity or a NaN survives every sum, and a sum of float32 values cannot overflow a double.
        (fx, fy, fz), (mx, my, mz) = self.force, self.torque
        (ax, ay, az), (rx, ry, rz) = self.acceleration, self.angular_rate
        total = self.temperature
        if self.orientation is not None:
            total += sum(self.orientation)
        return math.isfinite(total + fx + fy + fz + mx + my + mz + ax + ay + az + rx + ry + rz)


flags_of: Callable[[Values], tuple[int, ...]] = itemgetter(
    *(place for place, field in enumerate(PDO_FIELDS) if field.type is not PdoType.REAL)
)
"""The fields of `Sample` that say how the sensor is, `status` and those after it."""


class SampleDecoder:
    """Decodes process data of one size into `Sample`."""

    def __init__(self, size: int, imu_units: ImuUnits = ImuUnits.G_DPS) -> None:
        """PdoSizeError if no sensor has `size` bytes of process data."""
        self.layout = layout_for(size)
        in_si = imu_units is ImuUnits.SI
        self._acceleration_scale = 1.0 if in_si else STANDARD_GRAVITY
        self._angular_rate_scale = 1.0 if in_si else math.pi / 180.0
        self._unpack_from = self.layout.struct.unpack_from

    def decode(self, buffer: bytes | bytearray | memoryview, offset: int = 0) -> Sample:
        """Decode the process data that starts at `offset` of `buffer`.

        ValueError if the buffer holds too few bytes.
        """
        try:
            return self.sample(self._unpack_from(buffer, offset))
        except struct.error as error:
            raise ValueError(f"process data cut short: {error}") from None

    def sample(self, values: Values) -> Sample:
        """The sample whose fields were unpacked by the layout's `struct`."""
        acceleration, angular_rate = self.motion(values)
        fx, fy, fz, mx, my, mz = values[WRENCH]
        quaternion = values[ORIENTATION]
        (temperature,) = values[TEMPERATURE]
        return Sample(
            (fx, fy, fz), (mx, my, mz), acceleration, angular_rate, temperature,
            quaternion if any(quaternion) else None, *flags_of(values),
        )  # fmt: skip

    def motion(self, values: Values) -> tuple[Vector3, Vector3]:
        """Acceleration (m/s²) and angular rate (rad/s) of such fields."""
        ax, ay, az, _, rx, ry, rz = values[MOTION]
        a, r = self._acceleration_scale, self._angular_rate_scale
        return (ax * a, ay * a, az * a), (rx * r, ry * r, rz * r)


def encode(size: int, values: dict[str, float]) -> bytes:
    """Process data of `size` bytes from raw values by field name; fields not named are 0.

    For simulations and tests. KeyError names a field that this size does not have.
    """
    layout = layout_for(size)
    unknown = values.keys() - layout.offsets.keys()
    if unknown:
        raise KeyError(f"no field {sorted(unknown)[0]!r} in {size}-byte process data")
    return layout.struct.pack(
        *(
            float(values.get(f.name, 0.0)) if f.type is PdoType.REAL else int(values.get(f.name, 0))
            for f in layout.fields
        )
    )
