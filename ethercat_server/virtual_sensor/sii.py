"""The SII: the image in the sensor's EEPROM, and the registers through which a master reads it.

Sources: ETG.1000.6 and ETG.2010. The image is built from the tables of process data and objects. It cannot
be written: a write command ends with the error bit "write enable".
"""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.objects import PRODUCT_CODE, REVISION, VENDOR_ID
from ethercat_server.virtual_sensor import registers as reg
from ethercat_server.virtual_sensor.layout import RXPDO, SYNC_MANAGERS, TXPDO, Mapping, sync_manager_lengths

CATEGORIES: Final = 0x40
"""Word at which the categories begin."""
STRINGS, GENERAL, FMMUS, SYNC_MANAGERS_CATEGORY, TXPDOS, RXPDOS, END = 10, 30, 40, 41, 50, 51, 0xFFFF
PROTOCOL_COE: Final = 0x04
PROTOCOL_FOE: Final = 0x08
COE_SDO: Final = 0x01
COE_SDO_INFORMATION: Final = 0x02
IMAGE_SIZE: Final = 2048

_EIGHT_BYTE_READS = 0x0040
_BUSY = 0x8000
_ERROR_COMMAND = 0x2000
_ERROR_WRITE_ENABLE = 0x4000
_NO_OPERATION, _READ, _WRITE, _RELOAD = 0, 1, 2, 4


def checksum(data: bytes | bytearray) -> int:
    """The check byte of the configuration area: CRC-8, polynomial 0x07, start value 0xFF."""
    value = 0xFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x07 if value & 0x80 else value << 1) & 0xFF
    return value


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
    return struct.pack("<HH", kind, len(body) // 2) + body


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
    pdos = _category(TXPDOS, _pdo(TXPDO[pdo_size], strings)) + _category(RXPDOS, _pdo(RXPDO, strings))
    general = struct.pack(
        "<BBBBBBBBBBBBhHH14x",
        group, 0, name, name, 0, COE_SDO | COE_SDO_INFORMATION, 1, 0, 0, 0, 0, 0, 0, 0, 0x0011,
    )  # fmt: skip
    managers = b"".join(
        struct.pack("<HHBBBB", row.start, length, row.control, 0, 1, row.kind)
        for row, length in zip(SYNC_MANAGERS, sync_manager_lengths(pdo_size), strict=True)
    )
    head = bytearray(CATEGORIES * 2)
    head[0] = reg.PDI_TYPE
    head[14] = checksum(head[:14])
    struct.pack_into("<IIII", head, 0x08 * 2, VENDOR_ID, PRODUCT_CODE, REVISION, serial)
    struct.pack_into(
        "<HHHHH", head, 0x18 * 2,
        mailbox_out.start, mailbox_out.length, mailbox_in.start, mailbox_in.length,
        PROTOCOL_COE | PROTOCOL_FOE,
    )  # fmt: skip
    struct.pack_into("<HH", head, 0x3E * 2, IMAGE_SIZE // 128 - 1, 1)  # size in KBit - 1, version
    image = (
        bytes(head)
        + _category(STRINGS, strings.pack())
        + _category(GENERAL, general)
        + _category(FMMUS, b"\x01\x02\x03\xff")  # outputs, inputs, mailbox state
        + _category(SYNC_MANAGERS_CATEGORY, managers)
        + pdos
    )
    return image.ljust(IMAGE_SIZE, b"\xff")  # an erased EEPROM is all ones, which ends the categories too


class SiiInterface:
    """The registers 0x0500 to 0x050F. A command is done at once: the busy bit is seen with a fault only."""

    FAULTS: Final = {"ok": 0, "error": _ERROR_COMMAND, "busy": _BUSY}
    """By name: an EEPROM that answers, refuses, never answers."""

    def __init__(self, memory: bytearray, image: bytes) -> None:
        self._memory = memory
        self.image = image
        self._faults = 0
        self._set_status(0)

    def _set_status(self, bits: int) -> None:
        struct.pack_into("<H", self._memory, reg.SII_CONTROL, bits | _EIGHT_BYTE_READS)

    def fail(self, bits: int) -> None:
        """From now on reading ends with these bits of the control register; 0: it works."""
        self._faults = bits
        self._set_status(0)

    def command(self) -> None:
        """Do what the control register asks for, at the word in the address register."""
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
