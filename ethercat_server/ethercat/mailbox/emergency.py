"""CoE emergency messages: what a slave reports unasked, in words. Sources: ETG.1000.6, CiA 301."""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple, Self

_BODY: Final = struct.Struct("<HHB")
"""CoE header, error code, error register; manufacturer data follow."""
_SERVICE: Final = 1
_DATA_SIZE: Final = 5
_CLASS_MASK: Final = 0xFF00
ERROR_CLASSES: Final[dict[int, str]] = {
    0x0000: "error reset, or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current on the input side",
    0x2200: "current inside the device",
    0x2300: "current on the output side",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3200: "voltage inside the device",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "temperature of the device",
    0x5000: "hardware of the device",
    0x6000: "software of the device",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data set",
    0x7000: "additional modules",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8200: "protocol error",
    0x9000: "external error",
    0xA000: "change of the AL state failed",
    0xF000: "additional functions",
    0xFF00: "device-specific",
}
"""By error code without its lower byte; what is not here belongs to the class of its first digit."""


class Emergency(NamedTuple):
    """One emergency message."""

    code: int
    register: int
    """The error register, object 0x1001."""
    data: bytes
    """At most five bytes of the manufacturer's."""

    @classmethod
    def parse(cls, body: bytes) -> Self | None:
        """From a CoE message, without the mailbox header; None if it is no emergency."""
        if len(body) < _BODY.size:
            return None
        header, code, register = _BODY.unpack_from(body)
        if header >> 12 != _SERVICE:
            return None
        return cls(code, register, body[_BODY.size : _BODY.size + _DATA_SIZE])

    @property
    def is_reset(self) -> bool:
        """Whether it says that an error is over."""
        return not self.code & _CLASS_MASK

    @property
    def text(self) -> str:
        """The class of its error code in words."""
        known = ERROR_CLASSES.get(self.code & _CLASS_MASK) or ERROR_CLASSES.get(self.code & 0xF000)
        return known or "of no class that CiA 301 defines"

    def __str__(self) -> str:
        data = self.data.hex() or "none"
        return f"emergency 0x{self.code:04X} ({self.text}), error register 0x{self.register:02X}, data {data}"

    def as_json(self) -> dict[str, Any]:
        """The keys by which clients get it."""
        return {
            "code": self.code,
            "text": self.text,
            "register": self.register,
            "data": self.data.hex(),
        }
