"""The SII: the image in a slave's EEPROM, built from the tables of process data and objects.

Sources: ETG.1000.6 and ETG.2010.
"""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.ethercat.slave.sii import (
    CATEGORIES_WORD,
    CATEGORY_HEADER,
    CHECKED_BYTES,
    IDENTITY,
    IDENTITY_BYTE,
    MAILBOXES,
    MAILBOXES_BYTE,
    SYNC_MANAGER,
    Category,
    MailboxProtocol,
    checksum,
)
from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.slave.device import Device, Mapping

COE_SDO: Final = 0x01
COE_SDO_INFORMATION: Final = 0x02
IMAGE_SIZE: Final = 2048


class _Strings:
    """The strings category; strings are named by their number, from 1."""

    def __init__(self) -> None:
        self._known: dict[str, int] = {}

    def number(self, text: str) -> int:
        return self._known.setdefault(text, len(self._known) + 1)

    def pack(self) -> bytes:
        packed = b"".join(bytes([len(s)]) + s.encode("ascii") for s in self._known)
        return bytes([len(self._known)]) + packed


def _category(kind: int, body: bytes) -> bytes:
    body += b"\0" * (len(body) % 2)
    return CATEGORY_HEADER.pack(kind, len(body) // 2) + body if body else b""


def _pdo(pdo: Mapping, strings: _Strings) -> bytes:
    head = struct.pack(
        "<HBBBBH", pdo.index, len(pdo.entries), pdo.sync_manager, 0, strings.number(pdo.name), 0
    )
    return head + b"".join(
        struct.pack(
            "<HBBBBH", e.index, e.subindex, strings.number(e.name), e.type.coe_code, e.type.size * 8, 0
        )
        for e in pdo.entries
    )


def build_image(device: Device) -> bytes:
    """The whole EEPROM of such a slave."""
    strings = _Strings()
    name = strings.number(device.name)  # string 1: what masters show as the slave's name
    group = strings.number(device.group)
    inputs = _category(Category.TXPDOS, b"".join(_pdo(pdo, strings) for pdo in device.inputs))
    outputs = _category(Category.RXPDOS, b"".join(_pdo(pdo, strings) for pdo in device.outputs))
    coe_details = COE_SDO | COE_SDO_INFORMATION if device.protocols else 0
    general = struct.pack(
        "<BBBBBBBBBBBBhHH14x",
        group, 0, name, name, 0, coe_details, MailboxProtocol.FoE in device.protocols,
        0, 0, 0, 0, 0, device.bus_current_ma, 0, 0x0011,
    )  # fmt: skip
    managers = b"".join(
        SYNC_MANAGER.pack(row.start, row.length, row.control, 0, bool(row.length), row.kind)
        for row in device.sync_managers
    )
    head = bytearray(CATEGORIES_WORD * 2)
    head[0] = reg.PDI_TYPE
    head[CHECKED_BYTES] = checksum(head[:CHECKED_BYTES])
    IDENTITY.pack_into(head, IDENTITY_BYTE, device.vendor, device.product, device.revision, device.serial)
    if device.protocols:
        out, back = device.sync_managers[:2]
        MAILBOXES.pack_into(
            head, MAILBOXES_BYTE, out.start, out.length, back.start, back.length, device.protocols
        )
    struct.pack_into("<HH", head, 0x3E * 2, IMAGE_SIZE // 128 - 1, 1)  # size in KBit - 1, version
    image = (
        bytes(head)
        + _category(Category.STRINGS, strings.pack())
        + _category(Category.GENERAL, general)
        # Outputs, inputs, mailbox state.
        + _category(Category.FMMUS, b"\x01\x02\x03\xff" if managers else b"")
        + _category(Category.SYNC_MANAGERS, managers)
        + inputs
        + outputs
    )
    return image.ljust(IMAGE_SIZE, b"\xff")  # an erased EEPROM is all ones, which ends the categories too
