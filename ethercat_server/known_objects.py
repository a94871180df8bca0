"""Every object that the note lists, also those that the firmware seen does not have: what one may look at.

`objects` has those that a sensor is configured by.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from ethercat_server.objects import OBJECTS, Access, ObjectEntry, ObjectType


def _highest_subindices() -> Iterator[ObjectEntry]:
    """Sub-index 0 of each object that has parts, as Listing III.6 reads it."""
    highest: dict[int, int] = {}
    for row in OBJECTS:
        if row.subindex:
            highest[row.index] = max(row.subindex, highest.get(row.index, 0))
    for index, last in highest.items():
        yield ObjectEntry(index, 0, "Highest sub-index", ObjectType.U8, Access.RO, last)


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
