"""The AL (application layer) state machine as a master sees it: states, status register, error codes.

Source: ETG.1000.6. The texts are short forms of the standard's.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

_ERROR: Final = 0x10
_ACKNOWLEDGE: Final = 0x10
_STATE_MASK: Final = 0x0F

AL_STATUS_CODES: Final[dict[int, str]] = {
    0x0000: "no error",
    0x0001: "unspecified error",
    0x0002: "no memory",
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
            text += f" with AL status 0x{self.code:04X} ({AL_STATUS_CODES.get(self.code, 'no text known')})"
        return text
