"""Virtual sensors in memory that are wrong in one way; the program under test keeps its own tables."""

from __future__ import annotations

import struct
from collections.abc import Collection

import pytest

from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import AbortCode
from ethercat_server.virtual_sensor import application, device, dictionary
from ethercat_server.virtual_sensor.device import Device
from ethercat_server.virtual_sensor.mailbox import TransferRefusedError
from ethercat_server.virtual_sensor.sensor import Firmware

REFUSED = {(0x8006, 1): b"\x80\0", (0x8000, 5): struct.pack("<f", 0.5)}
FEWER = frozenset({(0x8010, 4), (0x8010, 5)})
FOREIGN_VENDOR = 0xDEAD
_VENDOR = slice(0x10, 0x14)
"""In the EEPROM."""
_PRODUCT = slice(0x14, 0x18)
_MAILBOXES = slice(0x30, 0x3A)


def refusing(patch: pytest.MonkeyPatch) -> None:
    """Refuses the SINC length 128, which is written last, and one offset."""
    check, write = dictionary.Dictionary.check_write, dictionary.Dictionary.write

    def refuse(self: dictionary.Dictionary, index: int, subindex: int, data: bytes, state: AlState) -> None:
        check(self, self.entry(index, subindex), len(data), state)
        if REFUSED.get((index, subindex)) == data:
            raise TransferRefusedError(AbortCode.INVALID_VALUE)
        write(self, index, subindex, data, state)

    patch.setattr(dictionary.Dictionary, "write", refuse)


def wrong_rate(patch: pytest.MonkeyPatch) -> None:
    """A sampling rate that the SINC length does not imply."""
    patch.setattr(dictionary, "sampling_rate_hz", lambda _: 500)


def fewer_objects(patch: pytest.MonkeyPatch) -> None:
    """No coordinate system and no inertia compensation."""
    _lack(patch, FEWER, AbortCode.NO_SUBINDEX)


def foreign(patch: pytest.MonkeyPatch) -> None:
    """No sensor of Bota's."""
    _change_eeprom(patch, _VENDOR, FOREIGN_VENDOR.to_bytes(4, "little"))


def other_product(patch: pytest.MonkeyPatch) -> None:
    _change_eeprom(patch, _PRODUCT, (7).to_bytes(4, "little"))


def no_mailbox(patch: pytest.MonkeyPatch) -> None:
    """No mailbox at all, as a simple slave."""
    _change_eeprom(patch, _MAILBOXES, bytes(10))
    patch.setattr(Firmware, "_fault_in", lambda *_: 0)


def _lack(patch: pytest.MonkeyPatch, addresses: Collection[tuple[int, int]], code: AbortCode) -> None:
    read = dictionary.Dictionary.read

    def read_some(self: dictionary.Dictionary, index: int, subindex: int) -> bytes:
        if (index, subindex) in addresses:
            raise TransferRefusedError(code)
        return read(self, index, subindex)

    patch.setattr(dictionary.Dictionary, "read", read_some)


def _change_eeprom(patch: pytest.MonkeyPatch, where: slice, data: bytes) -> None:
    build = device.build_image

    def changed(kind: Device) -> bytes:
        built = build(kind)
        return built[: where.start] + data + built[where.stop :]

    patch.setattr(application, "build_image", changed)
