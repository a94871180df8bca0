"""Reads a slave's SII, its EEPROM, through the controller's registers: one or two datagrams a step.

It is never written. Source: ETG.1000.4, registers 0x0500 to 0x050F. pysoem's own reading takes an EEPROM that
cannot be read for one full of zeros, after minutes.
"""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import Registers
from ethercat_server.ethercat.slave.coe import Steps
from ethercat_server.ethercat.slave.registers import SII_CONTROL, SII_OWNER

OF_FIRMWARE: Final = b"\x01"
OF_MASTER: Final = b"\x00"
_TAKE: Final = b"\x02"
_IN_USE: Final = 0x01  # of the byte after the owner: the firmware is accessing it

_REGISTERS: Final = struct.Struct("<HI8s")  # control and status, the word's address, the data
_COMMAND: Final = struct.Struct("<HI")
_READ: Final = 0x0100
_NONE: Final = 0x0000
_BUSY: Final = 0x8000
_ERRORS: Final = 0x7800
_EIGHT_BYTES: Final = 0x0040
_ATTEMPTS_TO_GIVE_BACK: Final = 3
_WORD_S: Final = 1.5  # an EEPROM behind a busy bus is slow


def read_sii(bus: Registers, slave: int, word: int, count: int, owner: bytes = OF_FIRMWARE) -> Steps[bytes]:
    """`count` words of the SII from `word` on, two bytes each; BusError if it cannot be read.

    `owner` is who has the right to use it afterwards, as in register 0x0500.
    """
    data = bytearray()
    try:
        yield from _wait_for_firmware(bus, slave)
        yield from _write(bus, slave, SII_OWNER, _TAKE, word)
        yield from _write(bus, slave, SII_OWNER, OF_MASTER, word)
        while len(data) < 2 * count:
            data += yield from _read_word(bus, slave, word + len(data) // 2)
    finally:
        # No waiting here: the one who reads may have given up.
        any(bus.write_register(slave, SII_OWNER, owner) for _ in range(_ATTEMPTS_TO_GIVE_BACK))
    return bytes(data[: 2 * count])


def _wait_for_firmware(bus: Registers, slave: int) -> Steps[None]:
    """Let the slave's own firmware finish an access; one that never does is interrupted."""
    deadline = Deadline(bus.clock, _WORD_S)
    while not deadline.passed:
        found = bus.read_register(slave, SII_OWNER, 2)
        if found is not None and not (found[0] & 1 and found[1] & _IN_USE):
            return
        yield


def _read_word(bus: Registers, slave: int, word: int) -> Steps[bytes]:
    """What one read command gives: two words, or four."""
    deadline = Deadline(bus.clock, _WORD_S)
    answer, asked = "no answer", False
    while not deadline.passed:
        if not asked:
            asked = bus.write_register(slave, SII_CONTROL, _COMMAND.pack(_READ, word))
            yield
            continue
        found = bus.read_register(slave, SII_CONTROL, _REGISTERS.size)
        if found is not None:
            status, address, data = _REGISTERS.unpack(found)
            if status & _BUSY:
                answer = f"it stays busy (status 0x{status:04X})"
            elif status & _ERRORS or address != word:
                answer = f"it refuses (status 0x{status:04X})"
                bus.write_register(slave, SII_CONTROL, _COMMAND.pack(_NONE, word))
                asked = False
            else:
                return bytes(data if status & _EIGHT_BYTES else data[:4])
        yield
    raise _unreadable(slave, word, answer)


def _write(bus: Registers, slave: int, address: int, data: bytes, word: int) -> Steps[None]:
    deadline = Deadline(bus.clock, _WORD_S)
    while not bus.write_register(slave, address, data):
        if deadline.passed:
            raise _unreadable(slave, word, "no answer")
        yield


def _unreadable(slave: int, word: int, why: str) -> BusError:
    return BusError(
        f"the SII of slave {slave} cannot be read at word 0x{word:04X}: {why}; power it off and on, "
        "then try again"
    )
