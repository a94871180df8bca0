"""SDO abort codes that the sensor gives. Source: ETG.1000.6."""

from __future__ import annotations

from enum import IntEnum


class Abort(IntEnum):
    """Why an SDO transfer ended."""

    TOGGLE_NOT_CHANGED = 0x05030000
    UNKNOWN_COMMAND = 0x05040001
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    LENGTH_MISMATCH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    NOT_IN_THIS_STATE = 0x08000022


class SdoAbortError(Exception):
    """The transfer ends with `code`."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort 0x{code:08X}")
        self.code = code
