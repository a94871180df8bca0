"""Finds objects by name (as in Bota's manual, the dictionary or the settings) or by address.

Only letters and digits count: `SINC length`, `sinc_length` and `Sinc-Length` are the same.
"""

from __future__ import annotations

import difflib
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from ethercat_server.sensor.objects.dictionary import OBJECTS, Access, ObjectEntry, ObjectType


def _highest_subindices() -> Iterator[ObjectEntry]:
    """Sub-index 0 of each object that has parts, as Listing III.6 reads it."""
    highest: dict[int, int] = {}
    for row in OBJECTS:
        if row.subindex:
            highest[row.index] = max(row.subindex, highest.get(row.index, 0))
    for index, last in highest.items():
        yield ObjectEntry(index, 0, "Highest sub-index", ObjectType.U8, Access.RO, last)


# Every object in Bota's manual, also those that the firmware seen does not have.
KNOWN_OBJECTS: Final[tuple[ObjectEntry, ...]] = tuple(
    sorted(
        (
            *OBJECTS,
            *_highest_subindices(),
            # Table III.1 has it, without a type; the firmware seen has none.
            ObjectEntry(0x8003, 0, "Force/torque range", ObjectType.OCTETS, Access.RO, ""),
        ),
        key=lambda row: row.address,
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

# Index, sub-index, name as in Table III.1 and Listing III.6; sub-index 0 of what has parts is all of it.
NOTE_NAMES: Final[tuple[tuple[int, int, str], ...]] = (
    (0x2000, 0, "Calibration"),
    (0x6000, 0, "Sensor Data"),
    (0x7000, 0, "Digital Output"),
    (0x8000, 0, "Force/Torque Offset"),
    (0x8001, 0, "Acceleration Offset"),
    (0x8002, 0, "Angular Velocities Offset"),
    (0x8003, 0, "Force/Torque Range"),
    (0x8004, 0, "Acceleration Range"),
    (0x8005, 0, "Angular Velocities Range"),
    (0x8006, 0, "Force/Torque Filter"),
    (0x8006, 1, "SINC Length"),
    (0x8006, 2, "FIR disable"),
    (0x8006, 3, "FAST enable"),
    (0x8006, 4, "CHOP enable"),
    (0x8007, 0, "Acceleration Filter"),
    (0x8008, 0, "Angular Velocities Filter"),
    (0x8010, 0, "Device configuration"),
    (0x8010, 1, "Force/Torque Calibration Matrix Active"),
    (0x8010, 1, "Calibration Matrix Active"),
    (0x8010, 2, "Temperature Compensation Active"),
    (0x8010, 2, "Temperature Compensation"),
    (0x8010, 3, "IMU Active"),
    (0x8010, 4, "Coordinate System Cong. Active"),
    (0x8010, 5, "Inertia and Gravity Comp. Active"),
    (0x8010, 6, "Orientation Estimation Active"),
    (0x8011, 0, "Sampling Rate"),
    (0x8030, 0, "Control"),
    (0x8030, 1, "Command"),
    (0x8030, 2, "Status"),
)

_ADDRESS: Final = re.compile(r"(0x[0-9a-f]{1,4})(?::(0x[0-9a-f]{1,2}|[0-9]{1,3}))?", re.IGNORECASE)


def find_objects(text: str) -> list[ObjectEntry]:
    """The entries that `text` names, in order of address; none if nothing is called so.

    An address that the dictionary does not have names an entry of its own: it can be read all the same.
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
    """Names that are spelled much like `text`. Takes milliseconds: not for the server's loop."""
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
        for name in {row.name, full_name(row), row.setting or row.name}:
            yield name, [row]
    for index, title in TITLES.items():
        yield title, _parts(index)
    for index, subindex, name in NOTE_NAMES:
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
