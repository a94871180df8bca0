"""What a kind of slave is: identity, sync managers, PDO mapping. EEPROM, AL checks and CoE objects follow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from ethercat_server.ethercat.slave.sii import MailboxProtocol
from ethercat_server.sensor.objects.dictionary import Access, ObjectEntry, ObjectType

MAILBOX_OUT, MAILBOX_IN, OUTPUTS, INPUTS = range(1, 5)
"""Kinds of sync managers, as in object 0x1C00."""
_NO_MAILBOX: Final = MailboxProtocol(0)
ASSIGNMENTS: Final = (0x1C12, 0x1C13)
"""Objects with the PDOs of sync managers 2 and 3."""
MAPPING_NAMES: Final = {
    0x1600: "Outputs mapping",
    0x1A00: "Inputs mapping",
    0x1A01: "Inputs mapping",
    0x1C00: "Sync manager communication type",
    0x1C12: "Outputs assignment",
    0x1C13: "Inputs assignment",
}


class SyncManagerRow(NamedTuple):
    """Required configuration of one sync manager."""

    start: int
    length: int
    """Bytes; 0 = not used."""
    control: int
    kind: int


@dataclass(frozen=True, slots=True)
class Mapping:
    """One PDO: its mapping object and the entries in it."""

    index: int
    name: str
    sync_manager: int
    entries: tuple[ObjectEntry, ...]

    @property
    def size(self) -> int:
        """Bytes of process data."""
        return sum(entry.type.size for entry in self.entries)


@dataclass(frozen=True, slots=True)
class Device:
    """One kind of slave, with its serial number."""

    name: str
    group: str
    vendor: int
    product: int
    revision: int
    serial: int = 0
    sync_managers: tuple[SyncManagerRow, ...] = ()
    """Of the mailbox, outputs, inputs, in this order; none without mailbox and process data."""
    outputs: tuple[Mapping, ...] = ()
    inputs: tuple[Mapping, ...] = ()
    protocols: MailboxProtocol = _NO_MAILBOX
    bus_current_ma: int = 0
    """Current that it takes from the bus behind the coupler; negative = supplies."""

    @property
    def pdos(self) -> tuple[Mapping, ...]:
        """All PDOs, outputs first."""
        return self.outputs + self.inputs

    @property
    def output_entries(self) -> list[ObjectEntry]:
        """What the outputs carry, in their order."""
        return [entry for pdo in self.outputs for entry in pdo.entries]

    @property
    def input_entries(self) -> list[ObjectEntry]:
        """What the inputs carry, in their order."""
        return [entry for pdo in self.inputs for entry in pdo.entries]


def mapping_rows(device: Device) -> list[ObjectEntry]:
    """The objects that describe sync managers and PDO mapping."""
    ro, u8, u16, u32 = Access.RO, ObjectType.U8, ObjectType.U16, ObjectType.U32
    rows = [
        ObjectEntry(0x1C00, n, f"Sync manager {n - 1}", u8, ro, row.kind)
        for n, row in enumerate(device.sync_managers, 1)
    ]
    for assignment, pdos in zip(ASSIGNMENTS, (device.outputs, device.inputs), strict=True):
        if not pdos:
            rows.append(ObjectEntry(assignment, 0, "Highest sub-index", u8, ro, 0))
        for number, pdo in enumerate(pdos, 1):
            rows.append(ObjectEntry(assignment, number, f"PDO {number}", u16, ro, pdo.index))
            for n, entry in enumerate(pdo.entries, 1):
                mapped = entry.index << 16 | entry.subindex << 8 | entry.type.size * 8
                rows.append(ObjectEntry(pdo.index, n, f"Entry {n}", u32, ro, mapped))
    return rows


def by_address(rows: Iterable[ObjectEntry]) -> dict[tuple[int, int], ObjectEntry]:
    """The rows, with the highest sub-index of every object that has parts, in order of address."""
    rows = list(rows)
    highest: dict[int, int] = {}
    for row in rows:
        if row.subindex:
            highest[row.index] = max(row.subindex, highest.get(row.index, 0))
    rows += [
        ObjectEntry(index, 0, "Highest sub-index", ObjectType.U8, Access.RO, last)
        for index, last in highest.items()
    ]
    return {row.address: row for row in sorted(rows, key=lambda row: row.address)}
