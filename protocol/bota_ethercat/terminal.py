# SPDX-License-Identifier: Apache-2.0
"""The inputs of a terminal beside the sensors: its process data by the layout in `describe`."""

from __future__ import annotations

import struct
from typing import Final

from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import rows, text, whole

_FLOATS: Final = {("f32", 32): "f", ("f64", 64): "d"}


def decode_terminal(terminal: JsonObject, process_data: bytes) -> dict[str, float]:
    """The values by name, in order; whole numbers and bits as int. `terminal` is its row in a description."""
    bits, values = int.from_bytes(process_data, "little"), dict[str, float]()
    for entry in rows(terminal.get("layout")):
        at, length = (whole(entry.get(key)) or 0 for key in ("bit_offset", "bit_length"))
        if not (0 < length <= 8 * len(process_data) - at and at >= 0):
            continue
        kind = text(entry.get("type"))
        value: float = bits >> at & (1 << length) - 1
        if form := _FLOATS.get((kind, length)):
            (value,) = struct.unpack(f"<{form}", int(value).to_bytes(length // 8, "little"))
        elif kind.startswith("i") and bits >> at + length - 1 & 1:
            value -= 1 << length
        values[text(entry.get("name"))] = value
    return values
