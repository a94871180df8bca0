"""The process data, against the table of object 0x6000 in Bota's manual, written out."""

from __future__ import annotations

import math
import struct

import pytest

from bota_ethercat.errors import PdoSizeError
from bota_ethercat.pdo import LAYOUTS, PDO_FIELDS, ImuUnits, SampleDecoder, encode, layout_for
from bota_ethercat.terminal import decode_terminal

# Name, offset, struct code, sub-index.
TABLE = [
    ("status", 0, "B", 0x01),
    ("warnings", 1, "I", 0x02),
    ("force.x", 5, "f", 0x04),
    ("force.y", 9, "f", 0x05),
    ("force.z", 13, "f", 0x06),
    ("torque.x", 17, "f", 0x07),
    ("torque.y", 21, "f", 0x08),
    ("torque.z", 25, "f", 0x09),
    ("force_torque_saturated", 29, "H", 0x0A),
    ("acceleration.x", 31, "f", 0x0B),
    ("acceleration.y", 35, "f", 0x0C),
    ("acceleration.z", 39, "f", 0x0D),
    ("acceleration_saturated", 43, "B", 0x0E),
    ("angular_rate.x", 44, "f", 0x0F),
    ("angular_rate.y", 48, "f", 0x10),
    ("angular_rate.z", 52, "f", 0x11),
    ("angular_rate_saturated", 56, "B", 0x12),
    ("temperature", 57, "f", 0x13),
    ("orientation.x", 61, "f", 0x14),
    ("orientation.y", 65, "f", 0x15),
    ("orientation.z", 69, "f", 0x16),
    ("orientation.w", 73, "f", 0x17),
]


def numbered(size: int) -> bytes:
    names = [row[0] for row in TABLE if row[1] < size]
    return encode(size, {name: float(n) for n, name in enumerate(names, 1)})


def test_offsets_types_and_subindices_are_the_tables() -> None:
    layout = layout_for(77)
    assert [(f.name, layout.offsets[f.name], f.type.value, f.subindex) for f in PDO_FIELDS] == TABLE
    assert [(size, layout_for(size).has_orientation) for size in sorted(LAYOUTS)] == [(61, False), (77, True)]


@pytest.mark.parametrize("size", [61, 77])
def test_every_field_lies_where_the_table_says(size: int) -> None:
    data = numbered(size)
    assert len(data) == size
    for number, (name, offset, code, _) in enumerate((r for r in TABLE if r[1] < size), 1):
        assert struct.unpack_from("<" + code, data, offset) == (number,), name
        assert layout_for(size).fields[layout_for(size).index(name)].name == name
    decoder = SampleDecoder(size, ImuUnits.SI)
    assert decoder.decode(data).array == [*range(3, 9), *range(10, 13), *range(14, 17)]
    assert decoder.decode(memoryview(b"?" * 7 + data + b"?"), 7) == decoder.decode(data)
    with pytest.raises(ValueError, match="cut short"):
        decoder.decode(bytes(size - 1))


def test_other_sizes_and_fields_are_named() -> None:
    for size in (0, 1, 60, 62, 76, 78, 1000):
        for refuse in (layout_for, SampleDecoder, lambda s: encode(s, {})):
            with pytest.raises(PdoSizeError, match=f"{size} bytes"):
                refuse(size)
    for size, field in ((61, "orientation.x"), (77, "weight")):
        with pytest.raises(KeyError, match=field):
            encode(size, {field: 1.0})


def test_numbers_that_are_not_finite_are_noticed() -> None:
    reals = [row[0] for row in TABLE if row[2] == "f"]
    for value in (math.nan, math.inf, -math.inf):
        for name in reals:
            data = encode(77, {"orientation.w": 1.0, name: value})
            assert not SampleDecoder(77).decode(data).is_finite, name
    assert not SampleDecoder(61).decode(encode(61, {"force.x": math.inf, "torque.x": -math.inf})).is_finite
    largest = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]
    assert SampleDecoder(77).decode(encode(77, dict.fromkeys(reals, largest))).is_finite


@pytest.mark.parametrize(
    ("kind", "at", "length", "value"),
    [
        ("bool", 3, 1, 1), ("u8", 0, 8, 0x68), ("u3", 4, 3, 6), ("i16", 8, 16, -2), ("i3", 4, 3, -2),
        ("f32", 24, 32, -0.5), ("f32", 24, 16, 0), ("STRING", 0, 56, 0xBF000000_FFFE68),
        ("u8", -1, 8, None), ("u8", 0, 57, None), ("u8", 0, 1 << 70, None),
    ],
)  # fmt: skip
def test_an_entry_of_a_terminal_is_decoded(kind: str, at: int, length: int, value: float | None) -> None:
    data = struct.pack("<Bhf", 0x68, -2, -0.5)
    entry = {"name": "Value", "type": kind, "bit_offset": at, "bit_length": length}
    assert decode_terminal({"layout": [entry]}, data).get("Value") == value
