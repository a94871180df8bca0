# SPDX-License-Identifier: Apache-2.0
"""The CoE base data types that `sdo_read` and `sdo_write` may name, and their values as JSON has them."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Final, NamedTuple

from bota_ethercat.option_types import choice, flag

SdoValue = bool | int | float | str


class SdoType(NamedTuple):
    """One type: its name, other names that people know it by, and how `struct` packs it."""

    name: str
    aliases: tuple[str, ...]
    format: str  # empty for text

    def pack(self, value: object) -> bytes:
        """The bytes of `value`; the text of ValueError is what is allowed."""
        if not self.format:
            if isinstance(value, str) and value.isascii():
                return value.encode("ascii")
            raise ValueError("a text of ASCII characters")
        if self.format == "<?":
            return struct.pack(self.format, flag.check(value))
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"a number that is a {self.name}")
        try:
            return struct.pack(self.format, value)
        except (struct.error, OverflowError):
            raise ValueError(f"a number that is a {self.name}") from None

    def unpack(self, data: bytes) -> SdoValue | None:
        """The value in `data`; ValueError if it has another size. None for what JSON has no number for."""
        if not self.format:
            return data.split(b"\0")[0].decode("ascii", errors="replace")
        try:
            (value,) = struct.unpack(self.format, data)
        except struct.error:
            size = struct.calcsize(self.format)
            raise ValueError(f"{len(data)} bytes are no {self.name}, which has {size}") from None
        if isinstance(value, float) and not math.isfinite(value):
            return None
        found: SdoValue = value
        return found


_ROWS: Final = (
    SdoType("bool", ("boolean",), "<?"),
    SdoType("i8", ("int8", "sint", "integer8"), "<b"),
    SdoType("i16", ("int16", "int", "integer16"), "<h"),
    SdoType("i32", ("int32", "dint", "integer32"), "<i"),
    SdoType("i64", ("int64", "lint", "integer64"), "<q"),
    SdoType("u8", ("uint8", "usint", "unsigned8", "byte", "bit8"), "<B"),
    SdoType("u16", ("uint16", "uint", "unsigned16"), "<H"),
    SdoType("u32", ("uint32", "udint", "unsigned32"), "<I"),
    SdoType("u64", ("uint64", "ulint", "unsigned64"), "<Q"),
    SdoType("f32", ("float32", "float", "real", "real32"), "<f"),
    SdoType("f64", ("float64", "double", "lreal", "real64"), "<d"),
    SdoType("string", ("visible_string", "str"), ""),
)

# By every name, in lower case.
SDO_TYPES: Final[Mapping[str, SdoType]] = {name: row for row in _ROWS for name in (row.name, *row.aliases)}

SDO_TYPE_NAMES: Final = tuple(row.name for row in _ROWS)


def sdo_type(name: object) -> SdoType:
    """The type of that name; ValueError lists those there are."""
    found = SDO_TYPES.get(name.lower()) if isinstance(name, str) else None
    if found is None:
        raise ValueError(choice(*SDO_TYPE_NAMES).allowed)
    return found
