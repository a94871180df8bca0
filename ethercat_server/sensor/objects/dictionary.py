"""The sensor's object dictionary: one row per object entry, found by address or by name.

Sources: the table of CoE objects in Bota's manual, the script that read them all (its name is still
scripts/sensor_configuration_SDO_reader.py), and the dump of a real Rokubi. The server configures the sensor
by it and the virtual sensor answers by it; nothing else knows an index.
"""

from __future__ import annotations

import difflib
import re
import struct
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from bota_ethercat import option_types
from bota_ethercat.pdo import AXES, INPUT_OBJECT, PDO_FIELDS, PdoType
from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.settings import SETTINGS, SettingValue
from bota_ethercat.text.did_you_mean import names_with
from ethercat_server.sensor.models import MODELS, PRODUCT_CODE, REVISION, VENDOR_ID


class ObjectType(Enum):
    """CoE base data type: its number in the SDO Information service, and its struct format."""

    BOOL = (0x0001, "<?")
    I8 = (0x0002, "<b")
    I16 = (0x0003, "<h")
    I32 = (0x0004, "<i")
    U8 = (0x0005, "<B")
    U16 = (0x0006, "<H")
    U32 = (0x0007, "<I")
    REAL32 = (0x0008, "<f")
    BIT8 = (0x0037, "<B")
    STRING = (0x0009, "")
    OCTETS = (0x000A, "")  # bytes whose meaning is not known; the value is their hexadecimal digits

    def __init__(self, coe_code: int, struct_format: str) -> None:
        self.coe_code = coe_code
        self.format = struct_format

    @property
    def size(self) -> int:
        """Bytes on the wire; 0 for strings and octets, whose length varies."""
        return struct.calcsize(self.format) if self.format else 0

    def pack(self, value: float | str) -> bytes:
        """Wire bytes of `value`; struct.error if it does not fit."""
        if isinstance(value, str):
            return bytes.fromhex(value) if self is ObjectType.OCTETS else value.encode("ascii")
        return struct.pack(self.format, value)

    def unpack(self, data: bytes) -> float | int | str:
        """The value in `data`; struct.error if the length is wrong."""
        if self is ObjectType.STRING:
            return data.rstrip(b"\0").decode("ascii", errors="replace")
        if self is ObjectType.OCTETS:
            return data.hex()
        value: float | int = struct.unpack(self.format, data)[0]
        return value


class Access(Enum):
    """Who may write an object entry, and in which AL state."""

    RO = "ro"
    RW = "rw"
    RW_PREOP = "rw in PREOP only"

    @property
    def write_states(self) -> tuple[str, ...]:
        """The AL states in which it may be written."""
        if self is Access.RO:
            return ()
        return ("PREOP",) if self is Access.RW_PREOP else ("PREOP", "SAFEOP", "OP")


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """One entry of the object dictionary."""

    index: int
    subindex: int
    name: str
    type: ObjectType
    access: Access
    default: float | str = 0  # factory default
    unit: str = ""
    setting: str | None = None  # name of the setting in `bota_ethercat.settings`
    codes: Mapping[SettingValue, int] | None = None  # wire value of each setting value, where they differ
    values: Mapping[int, str] | None = None  # meanings of wire values, for entries that are not settings

    @property
    def address(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.subindex

    @property
    def allowed(self) -> Mapping[int, str] | range | None:
        """Wire values that it may have with their meaning; a range of many; None if any value may be."""
        if self.setting is None:
            return self.values
        setting = SETTINGS[self.setting]
        if isinstance(setting.choices, range) and len(setting.choices) > 16:
            return setting.choices
        choices: tuple[SettingValue, ...] = tuple(setting.choices)
        meanings = {
            self.codes[value] if self.codes else int(value): value_meaning(self.setting, value)
            for value in choices
        }
        return dict(sorted(meanings.items()))

    def encode_setting(self, value: SettingValue) -> bytes:
        """Wire bytes of a checked setting value."""
        return self.type.pack(self.codes[value] if self.codes else int(value))

    def decode_setting(self, data: bytes) -> SettingValue:
        """The setting value in `data`; ValueError if it is none that the setting can have."""
        try:
            raw = self.type.unpack(data)
        except struct.error:
            raise ValueError(
                f"object 0x{self.index:04X}:{self.subindex} holds {data.hex() or 'nothing'}, which is no "
                f"{self.type.name}"
            ) from None
        if self.codes:
            for value, code in self.codes.items():
                if code == raw:
                    return value
            raise ValueError(f"object 0x{self.index:04X}:{self.subindex} holds {raw}, which means nothing")
        return bool(raw) if self.setting and SETTINGS[self.setting].type is option_types.flag else int(raw)


U8, U16, U32, REAL32 = ObjectType.U8, ObjectType.U16, ObjectType.U32, ObjectType.REAL32
STRING, OCTETS, BIT8, I8 = ObjectType.STRING, ObjectType.OCTETS, ObjectType.BIT8, ObjectType.I8
RO, RW, RW_PREOP = Access

_PDO_TYPES = {PdoType.USINT: U8, PdoType.UINT: U16, PdoType.UDINT: U32, PdoType.REAL: REAL32}
_INVERTED: Mapping[SettingValue, int] = {True: 0, False: 1}

# Writable on the device in every state. Never write it: the calibration is lost.
FACTORY_CALIBRATION: Final = 0x2000
FACTORY_CALIBRATION_ENTRIES: Final = 0x57

DEVICE_NAME: Final = (0x1008, 0)
HARDWARE_VERSION: Final = (0x1009, 0)
FIRMWARE_VERSION: Final = (0x100A, 0)
SERIAL_NUMBER: Final = (0x1018, 4)
FORCE_TORQUE_OFFSET: Final = 0x8000
SAMPLING_RATE: Final = (0x8011, 0)
CONTROL_COMMAND: Final = (0x8030, 1)
CONTROL_STATUS: Final = (0x8030, 2)
SAVE_PARAMETERS: Final = 1


def _calibration_type(subindex: int) -> ObjectType:
    """REAL32, except the password, the converters' offsets, range and gains, and the bridges' DACs."""
    if subindex == 0x01 or 0x27 <= subindex <= 0x2C or 0x4C <= subindex <= 0x51:
        return U32
    if subindex == 0x2D:
        return BIT8
    return I8 if subindex >= 0x52 else REAL32


# Those that the firmware seen has.
OBJECTS: Final[tuple[ObjectEntry, ...]] = (
    ObjectEntry(0x1000, 0, "Device type", U32, RO, 5001),
    ObjectEntry(0x1008, 0, "Device name", STRING, RO, MODELS[0]),
    ObjectEntry(0x1009, 0, "Hardware version", STRING, RO, "RM200V4_6adc"),
    ObjectEntry(0x100A, 0, "Firmware version", STRING, RO, "1.3.8-dirty-R"),
    ObjectEntry(0x1018, 1, "Vendor ID", U32, RO, VENDOR_ID),
    ObjectEntry(0x1018, 2, "Product code", U32, RO, PRODUCT_CODE),
    ObjectEntry(0x1018, 3, "Revision", U32, RO, REVISION),
    ObjectEntry(0x1018, 4, "Serial number", U32, RO, 1),
    *(
        ObjectEntry(FACTORY_CALIBRATION, sub, f"Calibration {sub}", _calibration_type(sub), RW)
        for sub in range(1, FACTORY_CALIBRATION_ENTRIES + 1)
    ),
    *(
        ObjectEntry(INPUT_OBJECT, field.subindex, field.title, _PDO_TYPES[field.type], RO, 0, field.unit)
        for field in PDO_FIELDS
    ),
    ObjectEntry(0x7000, 0, "Digital output", I8, RO),
    *(
        ObjectEntry(FORCE_TORQUE_OFFSET, sub, f"{axis} offset", REAL32, RW, 0, "N" if sub <= 3 else "Nm")
        for sub, axis in enumerate(AXES, 1)
    ),
    *(
        ObjectEntry(0x8001, sub, f"Acceleration offset {sub}", REAL32, RW, 0, "g" if sub <= 3 else "")
        for sub in range(1, 7)
    ),
    *(
        ObjectEntry(0x8002, sub, f"Angular rate offset {sub}", REAL32, RW, 0, "deg/s" if sub <= 3 else "")
        for sub in range(1, 7)
    ),
    ObjectEntry(
        0x8004, 0, "Acceleration range", BIT8, RW_PREOP, 0, "g",
        "acceleration_range_g", {2: 0, 4: 1, 8: 2, 16: 3},
    ),
    ObjectEntry(
        0x8005, 0, "Angular rate range", BIT8, RW_PREOP, 0, "deg/s",
        "angular_rate_range_dps", {250: 0, 500: 1, 1000: 2, 2000: 3},
    ),
    ObjectEntry(0x8006, 1, "SINC length", U16, RW_PREOP, 64, "", "sinc_length"),
    ObjectEntry(0x8006, 2, "FIR disable", U8, RW_PREOP, 1, "", "fir", _INVERTED),
    ObjectEntry(0x8006, 3, "FAST enable", U8, RW_PREOP, 0, "", "fast"),
    ObjectEntry(0x8006, 4, "CHOP enable", U8, RW_PREOP, 0, "", "chop"),
    ObjectEntry(0x8007, 0, "Acceleration filter", BIT8, RW_PREOP, 1, "", "acceleration_filter"),
    ObjectEntry(0x8008, 0, "Angular rate filter", BIT8, RW_PREOP, 3, "", "angular_rate_filter"),
    ObjectEntry(0x8010, 1, "Calibration matrix active", BIT8, RW, 1, "", "calibration_matrix"),
    ObjectEntry(0x8010, 2, "Temperature compensation", BIT8, RW, 0, "", "temperature_compensation"),
    ObjectEntry(0x8010, 3, "IMU active", BIT8, RW, 1, "", "imu_active"),
    ObjectEntry(0x8010, 4, "Coordinate system active", BIT8, RW, 0, "", "coordinate_system"),
    ObjectEntry(0x8010, 5, "Inertia and gravity compensation", BIT8, RW, 0, "", "inertia_compensation"),
    ObjectEntry(0x8010, 6, "Orientation estimation", BIT8, RW, 0, "", "orientation_estimation"),
    ObjectEntry(0x8011, 0, "Sampling rate", U16, RO, 800, "Hz"),
    ObjectEntry(0x8030, 1, "Command", U8, RW, values={SAVE_PARAMETERS: "save the parameters"}),
    ObjectEntry(0x8030, 2, "Status", U8, RO, values={0: "success"}),
)  # fmt: skip

BY_SETTING: Final[Mapping[str, ObjectEntry]] = {row.setting: row for row in OBJECTS if row.setting}

# The device works out the valid SINC range from the other filters, so SINC goes last.
_LAST: Final = ("chop", "fast", "fir", "sinc_length")
SETTING_WRITE_ORDER: Final = (*(name for name in SETTINGS if name not in _LAST), *_LAST)


def is_sensor(vendor: int, product: int) -> bool:
    """Whether this is the identity of a Bota Gen-0 sensor."""
    return (vendor, product) == (VENDOR_ID, PRODUCT_CODE)


def with_highest_subindices(rows: Sequence[ObjectEntry]) -> list[ObjectEntry]:
    """By address, with sub-index 0 of each object that has parts, as that script listed them."""
    highest: dict[int, int] = {}
    for row in rows:
        if row.subindex:
            highest[row.index] = max(row.subindex, highest.get(row.index, 0))
    added = (ObjectEntry(index, 0, "Highest sub-index", U8, RO, last) for index, last in highest.items())
    return sorted((*rows, *added), key=lambda row: row.address)


# Every object in Bota's manual, also those that the firmware seen does not have.
KNOWN_OBJECTS: Final[tuple[ObjectEntry, ...]] = tuple(
    with_highest_subindices(
        # The last one is in the manual, without a type, but not in the firmware seen.
        (*OBJECTS, ObjectEntry(0x8003, 0, "Force/torque range", OCTETS, RO, ""))
    )
)

BY_ADDRESS: Final[Mapping[tuple[int, int], ObjectEntry]] = {row.address: row for row in KNOWN_OBJECTS}

# Names of the objects that have parts.
TITLES: Final[Mapping[int, str]] = {
    0x1018: "Identity",
    0x2000: "Factory calibration",
    0x6000: "Measurement",
    0x8000: "Force/torque offset",
    0x8001: "Acceleration offset",
    0x8002: "Angular rate offset",
    0x8006: "Force/torque filter",
    0x8010: "Configuration",
    0x8030: "Control",
}

# Other names in the manual and in that script; sub-index 0 of what has parts is all of it.
MANUAL_NAMES: Final[tuple[tuple[int, int, str], ...]] = (
    (0x2000, 0, "Calibration"),
    (0x6000, 0, "Sensor Data"),
    (0x8002, 0, "Angular Velocities Offset"),
    (0x8005, 0, "Angular Velocities Range"),
    (0x8008, 0, "Angular Velocities Filter"),
    (0x8010, 0, "Device configuration"),
    (0x8010, 1, "Force/Torque Calibration Matrix Active"),
    (0x8010, 2, "Temperature Compensation Active"),
    (0x8010, 4, "Coordinate System Cong. Active"),
    (0x8010, 5, "Inertia and Gravity Comp. Active"),
    (0x8010, 6, "Orientation Estimation Active"),
)

_ADDRESS: Final = re.compile(r"(0x[0-9a-f]{1,4})(?::(0x[0-9a-f]{1,2}|[0-9]{1,3}))?", re.IGNORECASE)


def find_objects(text: str) -> list[ObjectEntry]:
    """The entries that `text` names, in order of address; none if nothing is called so.

    Only letters and digits count: `SINC length` and `sinc_length` are the same. An address that the
    dictionary does not have gives an entry without a type: it can be read too.
    """
    if (address := _ADDRESS.fullmatch(text.strip())) is None:
        return _BY_NAME.get(_plain(text), [])
    index, subindex = int(address[1], 16), _number(address[2] or "0")
    if subindex > 0xFF:
        return []
    if found := _entry(index, subindex) if address[2] else _parts(index):
        return found
    return [ObjectEntry(index, subindex, "Not in the dictionary", ObjectType.OCTETS, Access.RO, "")]


def similar_names(text: str) -> list[str]:
    """Names that have `text` in them, or are spelled much like it. Takes ms: not for the server's loop."""
    if having := names_with(text, _SPELLED.values()):
        return having
    return [_SPELLED[name] for name in difflib.get_close_matches(_plain(text), _SPELLED, n=3)]


def full_name(entry: ObjectEntry) -> str:
    """The entry's name with that of the object it is a part of, which no other entry has."""
    title = TITLES.get(entry.index)
    return f"{title} {entry.name}" if title else entry.name


def _number(text: str) -> int:
    return int(text, 16) if text.lower().startswith("0x") else int(text)


def _plain(text: str) -> str:
    return "".join(c for c in text.casefold() if c.isalnum())


def _parts(index: int) -> list[ObjectEntry]:
    return [row for row in KNOWN_OBJECTS if row.index == index]


def _entry(index: int, subindex: int) -> list[ObjectEntry]:
    row = BY_ADDRESS.get((index, subindex))
    return [row] if row else []


def _names() -> Iterable[tuple[str, Sequence[ObjectEntry]]]:
    for row in KNOWN_OBJECTS:
        for name in (row.name, full_name(row), row.setting or row.name):
            yield name, [row]
    for index, title in TITLES.items():
        yield title, _parts(index)
    for index, subindex, name in MANUAL_NAMES:
        whole = index in TITLES and subindex == 0
        yield name, _parts(index) if whole else _entry(index, subindex)


def _by_name() -> tuple[dict[str, list[ObjectEntry]], dict[str, str]]:
    found: dict[str, dict[tuple[int, int], ObjectEntry]] = defaultdict(dict)
    spelled: dict[str, str] = {}
    for name, rows in _names():
        found[_plain(name)].update({row.address: row for row in rows})
        spelled.setdefault(_plain(name), name)
    return {name: [rows[address] for address in sorted(rows)] for name, rows in found.items()}, spelled


_BY_NAME, _SPELLED = _by_name()
