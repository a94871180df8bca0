"""The registers through which a master reads a slave's EEPROM (SII), whose image is built in `slave.image`.

Source: ETG.1000.4. It is read-only: a write command is not acknowledged by the EEPROM, which is bit 13; one
without the write enable bit in the same frame never gets there, which is bit 14.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

from ethercat_server.virtual_sensor.esc import registers as reg

_EIGHT_BYTE_READS = 0x0040
_BUSY = 0x8000
_ERROR_COMMAND = 0x2000
_ERROR_WRITE_ENABLE = 0x4000
_NO_OPERATION, _READ, _WRITE, _RELOAD = 0, 1, 2, 4


class SiiInterface:
    """The registers 0x0500 to 0x050F. Reading takes `read_ns`; other commands are done at once."""

    FAULTS: Final = {"ok": 0, "error": _ERROR_COMMAND, "busy": _BUSY}
    """Error bits by name: an EEPROM that works, that returns an error, that stays busy."""

    def __init__(self, memory: bytearray, image: bytes, clock: Callable[[], int], read_ns: int) -> None:
        self._clock = clock
        self._read_ns = read_ns
        self._word = 0
        """What is being read."""
        self._done_at: int | None = None
        self._memory = memory
        self.image = image
        self._faults = 0
        self._set_status(0)

    def _set_status(self, bits: int) -> None:
        struct.pack_into("<H", self._memory, reg.SII_CONTROL, bits | _EIGHT_BYTE_READS)

    def fail(self, bits: int) -> None:
        """End every read with these bits of the control register; 0: no fault."""
        self._faults = bits
        self._done_at = None
        self._set_status(0)

    def advance(self) -> None:
        """The registers are about to be read: what was being read may be there."""
        if self._done_at is not None and self._clock() >= self._done_at:
            at = self._word * 2
            self._memory[reg.SII_DATA : reg.SII_DATA + 8] = self.image[at : at + 8].ljust(8, b"\xff")
            self._done_at = None
            self._set_status(0)

    def command(self) -> None:
        """Execute the command in the control register at the word in the address register."""
        control, word = struct.unpack_from("<HI", self._memory, reg.SII_CONTROL)
        self.advance()
        if self._done_at is not None:  # it takes no command meanwhile
            self._set_status(_BUSY)
            struct.pack_into("<I", self._memory, reg.SII_ADDRESS, self._word)
            return
        if self._memory[reg.SII_CONFIGURATION] & 0x01:
            # The interface belongs to the sensor's firmware until the master takes it back.
            self._set_status(_ERROR_COMMAND)
            return
        operation = control >> 8 & 0x07
        if operation == _READ and self._faults:
            self._set_status(self._faults)
        elif operation == _READ:
            self._done_at, self._word = self._clock() + self._read_ns, word
            self._set_status(_BUSY)
            self.advance()
        elif operation == _WRITE:
            self._set_status(_ERROR_COMMAND if control & 0x01 else _ERROR_WRITE_ENABLE)
        elif operation in (_NO_OPERATION, _RELOAD):
            self._set_status(0)
        else:
            self._set_status(_ERROR_COMMAND)
