"""What a kind of slave is: identity, sync managers, PDO mapping; the objects of these, and its EEPROM.

Sources: ETG.1000.6 and ETG.2010.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave import sii
from ethercat_server.sensor.objects.dictionary import (
    Access,
    ObjectEntry,
    ObjectType,
    with_highest_subindices,
)

MAILBOX_OUT, MAILBOX_IN, OUTPUTS, INPUTS = range(1, 5)  # kinds of sync managers, as in object 0x1C00
_NO_MAILBOX: Final = sii.MailboxProtocol(0)
_COE_SDO, _COE_SDO_INFORMATION = 0x01, 0x02
_IMAGE_SIZE: Final = 2048
PDI_TYPE: Final = 0x05  # SPI slave, as the register says too


class SyncManagerRow(NamedTuple):
    """Required configuration of one sync manager."""

    start: int
    length: int  # bytes; 0: not used
    control: int
    kind: int


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO: its mapping object and the entries in it."""

    index: int
    name: str
    entries: tuple[ObjectEntry, ...]


@dataclass(frozen=True, slots=True)
class Device:
    """One kind of slave, with its serial number."""

    name: str
    group: str
    vendor: int
    product: int
    revision: int
    serial: int = 0
    outputs: tuple[Pdo, ...] = ()
    inputs: tuple[Pdo, ...] = ()
    protocols: sii.MailboxProtocol = _NO_MAILBOX
    watchdog: bool = False  # outputs trigger the process data watchdog
    device_type: int = 0  # object 0x1000
    bus_current_ma: int = 0  # taken from the bus behind the coupler; negative: supplied

    @property
    def sync_managers(self) -> tuple[SyncManagerRow, ...]:
        """Of the mailbox, outputs, inputs, in this order; without a mailbox of inputs only."""
        if not self.protocols:
            size = size_of(self.input_entries)
            return (SyncManagerRow(0x1000, size, 0x00, INPUTS),) if size else ()
        return (
            SyncManagerRow(0x1000, 128, reg.SM_CONTROL_MAILBOX_OUT, MAILBOX_OUT),
            SyncManagerRow(0x1080, 128, reg.SM_CONTROL_MAILBOX_IN, MAILBOX_IN),
            SyncManagerRow(0x1100, size_of(self.output_entries), 0x64 if self.watchdog else 0x24, OUTPUTS),
            SyncManagerRow(0x1180, size_of(self.input_entries), 0x20, INPUTS),
        )

    @property
    def output_entries(self) -> list[ObjectEntry]:
        return [entry for pdo in self.outputs for entry in pdo.entries]

    @property
    def input_entries(self) -> list[ObjectEntry]:
        return [entry for pdo in self.inputs for entry in pdo.entries]


def size_of(entries: Iterable[ObjectEntry]) -> int:
    """Bytes of the process data that carries these."""
    return (sum(map(bits_of, entries)) + 7) // 8


def bits_of(entry: ObjectEntry) -> int:
    """Bits of an entry in process data."""
    return 1 if entry.type is ObjectType.BOOL else 8 * entry.type.size


def _mapping_rows(device: Device) -> list[ObjectEntry]:
    """The objects that describe sync managers and PDO mapping."""
    ro, u8, u16, u32 = Access.RO, ObjectType.U8, ObjectType.U16, ObjectType.U32
    rows = [
        ObjectEntry(0x1C00, n, f"Sync manager {n - 1}", u8, ro, row.kind)
        for n, row in enumerate(device.sync_managers, 1)
    ]
    for assignment, pdos in ((0x1C12, device.outputs), (0x1C13, device.inputs)):
        if not pdos:
            rows.append(ObjectEntry(assignment, 0, "Highest sub-index", u8, ro, 0))
        for number, pdo in enumerate(pdos, 1):
            rows.append(ObjectEntry(assignment, number, f"PDO {number}", u16, ro, pdo.index))
            for n, entry in enumerate(pdo.entries, 1):
                mapped = entry.index << 16 | entry.subindex << 8 | bits_of(entry)
                rows.append(ObjectEntry(pdo.index, n, f"Entry {n}", u32, ro, mapped))
    return rows


def entries_of(device: Device, rows: Iterable[ObjectEntry]) -> dict[tuple[int, int], ObjectEntry]:
    """These and those of the PDO mapping, with the highest sub-index of each object, in order of address."""
    return {row.address: row for row in with_highest_subindices([*rows, *_mapping_rows(device)])}


def build_image(device: Device) -> bytes:
    """The whole EEPROM of such a slave."""
    strings: dict[str, int] = {}  # named by their number, from 1

    def number(text: str) -> int:
        return strings.setdefault(text, len(strings) + 1)

    def category(kind: sii.Category, body: bytes) -> bytes:
        body += b"\0" * (len(body) % 2)
        return sii.CATEGORY_HEADER.pack(kind, len(body) // 2) + body if body else b""

    def mapping(pdos: Sequence[Pdo], manager: int) -> bytes:
        heads = (
            sii.PDO.pack(pdo.index, len(pdo.entries), manager, 0, number(pdo.name), 0)
            + b"".join(
                sii.PDO.pack(e.index, e.subindex, number(e.name), e.type.coe_code, bits_of(e), 0)
                for e in pdo.entries
            )
            for pdo in pdos
        )
        return b"".join(heads)

    name, group = number(device.name), number(device.group)  # string 1: what masters show as its name
    inputs = category(sii.Category.TXPDOS, mapping(device.inputs, len(device.sync_managers) - 1))
    outputs = category(sii.Category.RXPDOS, mapping(device.outputs, 2))
    general = struct.pack(
        "<BBBBBBBBBBBBhHH14x",
        group, 0, name, name, 0, _COE_SDO | _COE_SDO_INFORMATION if device.protocols else 0,
        sii.MailboxProtocol.FoE in device.protocols, 0, 0, 0, 0, 0, device.bus_current_ma, 0, 0x0011,
    )  # fmt: skip
    managers = b"".join(
        sii.SYNC_MANAGER.pack(row.start, row.length, row.control, 0, bool(row.length), row.kind)
        for row in device.sync_managers
    )
    head = bytearray(sii.CATEGORIES_WORD * 2)
    head[0] = PDI_TYPE
    head[sii.CHECKED_BYTES] = sii.checksum(head[: sii.CHECKED_BYTES])
    sii.IDENTITY.pack_into(
        head, sii.IDENTITY_BYTE, device.vendor, device.product, device.revision, device.serial
    )
    if device.protocols:
        areas = itertools.chain.from_iterable(row[:2] for row in device.sync_managers[:2])
        sii.MAILBOXES.pack_into(head, sii.MAILBOXES_BYTE, *areas, device.protocols)
    struct.pack_into("<HH", head, 0x3E * 2, _IMAGE_SIZE // 128 - 1, 1)  # size in KBit - 1, version
    texts = b"".join(bytes([len(text)]) + text.encode("ascii") for text in strings)
    image = (
        bytes(head)
        + category(sii.Category.STRINGS, bytes([len(strings)]) + texts)
        + category(sii.Category.GENERAL, general)
        # Outputs, inputs, mailbox state.
        + category(sii.Category.FMMUS, b"\1\2\3\xff" if device.protocols else b"\2\xff" if managers else b"")
        + category(sii.Category.SYNC_MANAGERS, managers)
        + inputs
        + outputs
    )
    return image.ljust(_IMAGE_SIZE, b"\xff")  # an erased EEPROM is all ones, which ends the categories too
