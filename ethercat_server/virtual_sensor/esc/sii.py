"""The SII: the image in the sensor's EEPROM, and the registers through which a master reads it.

Sources: ETG.1000.6 and ETG.2010. The image is built from the tables of process data and objects. It is
read-only: a write command ends with the error bit "write enable".
"""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.ethercat.slave.sii_content import (
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
from ethercat_server.sensor.objects.dictionary import PRODUCT_CODE, REVISION, VENDOR_ID
from ethercat_server.virtual_sensor.esc import registers as reg
from ethercat_server.virtual_sensor.firmware.layout import (
    RXPDO,
    SYNC_MANAGERS,
    TXPDO,
    Mapping,
    sync_manager_lengths,
)

COE_SDO: Final = 0x01
COE_SDO_INFORMATION: Final = 0x02
IMAGE_SIZE: Final = 2048

_EIGHT_BYTE_READS = 0x0040
_BUSY = 0x8000
_ERROR_COMMAND = 0x2000
_ERROR_WRITE_ENABLE = 0x4000
_NO_OPERATION, _READ, _WRITE, _RELOAD = 0, 1, 2, 4


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
    return CATEGORY_HEADER.pack(kind, len(body) // 2) + body


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


def build_image(model: str, serial: int, pdo_size: int) -> bytes:
    """The whole EEPROM of a sensor called `model` that maps `pdo_size` bytes of inputs."""
    mailbox_out, mailbox_in = SYNC_MANAGERS[0], SYNC_MANAGERS[1]
    strings = _Strings()
    name = strings.number(model)  # string 1: what masters show as the slave's name
    group = strings.number("Force/torque sensors")
    inputs = _category(Category.TXPDOS, _pdo(TXPDO[pdo_size], strings))
    outputs = _category(Category.RXPDOS, _pdo(RXPDO, strings))
    general = struct.pack(
        "<BBBBBBBBBBBBhHH14x",
        group, 0, name, name, 0, COE_SDO | COE_SDO_INFORMATION, 1, 0, 0, 0, 0, 0, 0, 0, 0x0011,
    )  # fmt: skip
    managers = b"".join(
        SYNC_MANAGER.pack(row.start, length, row.control, 0, 1, row.kind)
        for row, length in zip(SYNC_MANAGERS, sync_manager_lengths(pdo_size), strict=True)
    )
    head = bytearray(CATEGORIES_WORD * 2)
    head[0] = reg.PDI_TYPE
    head[CHECKED_BYTES] = checksum(head[:CHECKED_BYTES])
    IDENTITY.pack_into(head, IDENTITY_BYTE, VENDOR_ID, PRODUCT_CODE, REVISION, serial)
    MAILBOXES.pack_into(
        head, MAILBOXES_BYTE,
        mailbox_out.start, mailbox_out.length, mailbox_in.start, mailbox_in.length,
        MailboxProtocol.CoE | MailboxProtocol.FoE,
    )  # fmt: skip
    struct.pack_into("<HH", head, 0x3E * 2, IMAGE_SIZE // 128 - 1, 1)  # size in KBit - 1, version
    image = (
        bytes(head)
        + _category(Category.STRINGS, strings.pack())
        + _category(Category.GENERAL, general)
        + _category(Category.FMMUS, b"\x01\x02\x03\xff")  # outputs, inputs, mailbox state
        + _category(Category.SYNC_MANAGERS, managers)
        + inputs
        + outputs
    )
    return image.ljust(IMAGE_SIZE, b"\xff")  # an erased EEPROM is all ones, which ends the categories too


class SiiInterface:
    """The registers 0x0500 to 0x050F. A command is done at once: the busy bit is seen with a fault only."""

    FAULTS: Final = {"ok": 0, "error": _ERROR_COMMAND, "busy": _BUSY}
    """Error bits by name: an EEPROM that works, that returns an error, that stays busy."""

    def __init__(self, memory: bytearray, image: bytes) -> None:
        self._memory = memory
        self.image = image
        self._faults = 0
        self._set_status(0)

    def _set_status(self, bits: int) -> None:
        struct.pack_into("<H", self._memory, reg.SII_CONTROL, bits | _EIGHT_BYTE_READS)

    def fail(self, bits: int) -> None:
        """End every read with these bits of the control register; 0: no fault."""
        self._faults = bits
        self._set_status(0)

    def command(self) -> None:
        """Execute the command in the control register at the word in the address register."""
        control, word = struct.unpack_from("<HI", self._memory, reg.SII_CONTROL)
        if self._memory[reg.SII_CONFIGURATION] & 0x01:
            # The interface belongs to the sensor's firmware until the master takes it back.
            self._set_status(_ERROR_COMMAND)
            return
        operation = control >> 8 & 0x07
        if operation == _READ and self._faults:
            self._set_status(self._faults)
        elif operation == _READ:
            data = self.image[word * 2 : word * 2 + 8].ljust(8, b"\xff")
            self._memory[reg.SII_DATA : reg.SII_DATA + 8] = data
            self._set_status(0)
        elif operation == _WRITE:
            self._set_status(_ERROR_WRITE_ENABLE)
        elif operation in (_NO_OPERATION, _RELOAD):
            self._set_status(0)
        else:
            self._set_status(_ERROR_COMMAND)
