"""The AL (application layer) state machine as a master sees it: states, status register, error codes.

Source: ETG.1000.6; the error codes: ETG.1020. The texts are short forms of the standards'.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

_ERROR: Final = 0x10
_ACKNOWLEDGE: Final = 0x10
_STATE_MASK: Final = 0x0F
_VENDOR_CODES: Final = 0x8000  # from here on

AL_STATUS_CODES: Final[dict[int, str]] = {
    0x0000: "no error",
    0x0001: "unspecified error",
    0x0002: "no memory",
    0x0003: "invalid device setup",
    0x0004: "the mapping does not fit this revision",
    0x0006: "firmware and EEPROM do not match",
    0x0007: "firmware update failed, the old firmware runs",
    0x0011: "invalid requested state change",
    0x0012: "unknown requested state",
    0x0013: "bootstrap not supported",
    0x0014: "no valid firmware",
    0x0015: "invalid mailbox configuration in BOOT",
    0x0016: "invalid mailbox configuration",
    0x0017: "invalid sync manager configuration",
    0x0018: "no valid inputs",
    0x0019: "no valid outputs",
    0x001A: "synchronization error",
    0x001B: "sync manager watchdog: no process data came for too long",
    0x001C: "invalid sync manager types",
    0x001D: "invalid output configuration",
    0x001E: "invalid input configuration",
    0x001F: "invalid watchdog configuration",
    0x0020: "needs a cold start",
    0x0021: "needs INIT",
    0x0022: "needs PREOP",
    0x0023: "needs SAFEOP",
    0x0024: "invalid input mapping",
    0x0025: "invalid output mapping",
    0x0026: "inconsistent settings",
    0x0027: "free run is not supported",
    0x0028: "the synchronization mode is not supported",
    0x0029: "free run needs a sync manager with three buffers",
    0x002A: "background watchdog",
    0x002B: "neither inputs nor outputs are valid",
    0x002C: "fatal synchronization error: sync signals stopped",
    0x002D: "no synchronization: sync signals were never received",
    0x002E: "the cycle time is too short (older devices: invalid input FMMU)",
    0x0030: "invalid distributed clock (sync) configuration",
    0x0031: "invalid distributed clock (latch) configuration",
    0x0032: "its PLL does not lock to the distributed clock",
    0x0033: "distributed clock: input/output error",
    0x0034: "distributed clock: sync timeout",
    0x0035: "distributed clock: invalid sync cycle time",
    0x0036: "distributed clock: invalid SYNC0 cycle time",
    0x0037: "distributed clock: invalid SYNC1 cycle time",
    0x0041: "mailbox error in AoE",
    0x0042: "mailbox error in EoE",
    0x0043: "mailbox error in CoE",
    0x0044: "mailbox error in FoE",
    0x0045: "mailbox error in SoE",
    0x004F: "mailbox error in VoE",
    0x0050: "no access to its EEPROM",
    0x0051: "EEPROM error",
    0x0052: "external hardware is not ready",
    0x0060: "it restarted by itself",
    0x0061: "its device identification was changed",
    0x0070: "the modules found are not those configured",
    0x0080: "supply voltage too low",
    0x0081: "supply voltage too high",
    0x0082: "temperature too low",
    0x0083: "temperature too high",
    0x00F0: "application controller available",
}


class AlState(IntEnum):
    """AL states by their number in the register; NONE is anything the standard does not know."""

    NONE = 0
    INIT = 1
    PREOP = 2
    BOOT = 3
    SAFEOP = 4
    OP = 8

    def request(self) -> bytes:
        """What to write to AL control to go there."""
        return struct.pack("<H", self)


# Real devices are slow: firmware that starts, filters that are initialized.
# Timeout for an AL state after it was requested.
STATE_S: Final = {AlState.INIT: 5.0, AlState.PREOP: 10.0, AlState.SAFEOP: 10.0, AlState.OP: 10.0}
ACKNOWLEDGE_S: Final = 5.0  # timeout for an error to be gone after it was acknowledged


class AlStatus(NamedTuple):
    """The AL status register with the code behind it."""

    raw_state: int
    error: bool
    code: int

    @classmethod
    def parse(cls, data: bytes) -> AlStatus:
        """From the six bytes at 0x0130."""
        status, _, code = struct.unpack("<HHH", data)
        return cls.of(status, code)

    @classmethod
    def of(cls, status: int, code: int) -> AlStatus:
        """From the two registers."""
        return cls(status & _STATE_MASK, bool(status & _ERROR), code)

    @property
    def state(self) -> AlState:
        """The state the sensor is in."""
        try:
            return AlState(self.raw_state)
        except ValueError:
            return AlState.NONE

    @property
    def is_above_preop(self) -> bool:
        """Whether it is in SAFEOP or OP: its process data is exchanged."""
        return bool(self.raw_state & (AlState.SAFEOP | AlState.OP))

    @property
    def is_op(self) -> bool:
        """Whether the sensor is in OP, without an error."""
        return self.raw_state == AlState.OP and not self.error

    def acknowledge(self) -> bytes:
        """What to write to AL control to acknowledge the error and stay in this state."""
        return struct.pack("<H", self.raw_state | _ACKNOWLEDGE)

    def __str__(self) -> str:
        """For people: state, and the error if there is one."""
        text = self.state.name
        if self.error:
            text += f" with AL status 0x{self.code:04X} ({_meaning(self.code)})"
        return text


def _meaning(code: int) -> str:
    return AL_STATUS_CODES.get(code, "the vendor's own code" if code >= _VENDOR_CODES else "reserved")
