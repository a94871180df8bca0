"""SDO abort codes and their meanings. Source: ETG.1000.6, table "SDO Abort Codes"."""

from __future__ import annotations

from enum import IntEnum
from typing import Self

from ethercat_server.errors import SdoAbortError


class AbortCode(IntEnum):
    """Reason why a slave aborted an SDO transfer."""

    meaning: str

    def __new__(cls, code: int, meaning: str) -> Self:
        """A code with its meaning, which completes the sentence "the sensor refused: ..."."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.meaning = meaning
        return member

    TOGGLE_NOT_CHANGED = 0x05030000, "the toggle bit did not alternate"
    TIMEOUT = 0x05040000, "the SDO protocol timed out"
    UNKNOWN_COMMAND = 0x05040001, "the command specifier is invalid or unknown"
    OUT_OF_MEMORY = 0x05040005, "out of memory"
    UNSUPPORTED_ACCESS = 0x06010000, "unsupported access to an object"
    WRITE_ONLY = 0x06010001, "the object is write-only"
    READ_ONLY = 0x06010002, "the object is read-only"
    SUBINDEX_0_NOT_ZERO = 0x06010003, "sub-index 0 must be set to 0 before the sub-indices are written"
    NO_COMPLETE_ACCESS = 0x06010004, "complete access is not supported for entries of variable length"
    LONGER_THAN_MAILBOX = 0x06010005, "the object is longer than the mailbox"
    MAPPED_TO_RXPDO = 0x06010006, "the object is mapped to an RxPDO, so it cannot be written"
    NO_OBJECT = 0x06020000, "the object does not exist"
    NOT_MAPPABLE = 0x06040041, "the object cannot be mapped to a PDO"
    MAPPING_TOO_LONG = 0x06040042, "the mapped objects exceed the length of the PDO"
    PARAMETERS_INCOMPATIBLE = 0x06040043, "the parameters are incompatible"
    DEVICE_INCOMPATIBLE = 0x06040047, "the device is incompatible"
    HARDWARE_ERROR = 0x06060000, "access failed because of a hardware error"
    LENGTH_MISMATCH = 0x06070010, "the data type or length does not match"
    TOO_LONG = 0x06070012, "the data is too long"
    TOO_SHORT = 0x06070013, "the data is too short"
    NO_SUBINDEX = 0x06090011, "the sub-index does not exist"
    INVALID_VALUE = 0x06090030, "the value is out of range"
    TOO_HIGH = 0x06090031, "the value is too high"
    TOO_LOW = 0x06090032, "the value is too low"
    MAXIMUM_BELOW_MINIMUM = 0x06090036, "the maximum is less than the minimum"
    GENERAL = 0x08000000, "general error"
    CANNOT_STORE = 0x08000020, "the data cannot be transferred or stored"
    LOCAL_CONTROL = 0x08000021, "the data cannot be transferred or stored because of local control"
    NOT_IN_THIS_STATE = 0x08000022, "the data cannot be transferred or stored in the present state"
    NO_DICTIONARY = 0x08000023, "there is no object dictionary"


def abort_meaning(code: int) -> str:
    """The meaning of an abort code."""
    known = next((row for row in AbortCode if row == code), None)
    return known.meaning if known else "a reason that the standard does not define"


def refused(number: int, doing: str, code: int) -> SdoAbortError:
    """Sensor `number` aborted an SDO; `doing` is such as "reading object 0x8011:0"."""
    text = f"sensor {number} refused {doing}: {abort_meaning(code)} (abort 0x{code:08X})"
    return SdoAbortError(text, code)
