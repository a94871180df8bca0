"""A message that is serialised once; for each sample only its numbers are replaced.

rclpy converts and serialises a message anew for every `publish`, which takes longer than handing it to the
middleware does. Where the numbers stand is not worked out from rules: they are found in the serialised bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, Final

from rclpy.serialization import serialize_message

_DOUBLE: Final = struct.Struct("<d")
_STAMP: Final = struct.Struct("<iI")
_LITTLE_ENDIAN: Final = b"\x00\x01"
"""How serialised bytes (CDR) begin on every machine that ROS 2 Jazzy is built for."""
_NS_PER_S: Final = 1_000_000_000
_MARK: Final = 1.2345678901234567e300
_STAMP_MARK: Final = (0x12345678, 0x09ABCDEF)

Place = tuple[Any, str | int]
"""Where a number is: an object and its attribute, or a sequence and an index."""


class SerializedMessage:
    """`message` in serialised form, with the numbers at `places` to be replaced.

    `places` are runs of float64 fields, each run without anything between; `stamp` is the header's, if any.
    All of them are 0 after this. ValueError if they cannot be told apart in the serialised bytes.
    """

    def __init__(self, message: Any, positions: Sequence[Sequence[Place]], stamp: Any = None) -> None:
        marks = iter(_MARK + n * 1e290 for n in range(1000))
        runs = [[(position, next(marks)) for position in run] for run in positions]
        for run in runs:
            for position, mark in run:
                _put(position, mark)
        if stamp is not None:
            stamp.sec, stamp.nanosec = _STAMP_MARK
        marked = serialize_message(message)
        if not marked.startswith(_LITTLE_ENDIAN):
            raise ValueError("the middleware does not serialise as little-endian CDR")
        self._offsets = [
            _find(marked, b"".join(_DOUBLE.pack(mark) for _, mark in run)) for run in runs
        ]  # fmt: skip
        self._stamp_offset = -1 if stamp is None else _find(marked, _STAMP.pack(*_STAMP_MARK))
        for run in runs:
            for position, _ in run:
                _put(position, 0.0)
        if stamp is not None:
            stamp.sec = stamp.nanosec = 0
        self._buffer = bytearray(serialize_message(message))
        self._packers = [struct.Struct(f"<{len(run)}d").pack_into for run in runs]

    def stamp(self, stamp_ns: int) -> None:
        """Put the time in, ns since the Unix epoch."""
        _STAMP.pack_into(self._buffer, self._stamp_offset, *divmod(stamp_ns, _NS_PER_S))

    def fill(self, run: int, values: Sequence[float]) -> None:
        """Put `values` into the numbers of this run."""
        self._packers[run](self._buffer, self._offsets[run], *values)

    def filled(self, stamp_ns: int, values: Sequence[float]) -> bytes:
        """`stamp`, `fill` the first run, and `message` in one."""
        buffer = self._buffer
        _STAMP.pack_into(buffer, self._stamp_offset, *divmod(stamp_ns, _NS_PER_S))
        self._packers[0](buffer, self._offsets[0], *values)
        return bytes(buffer)

    def message(self) -> bytes:
        """What a publisher takes in a message's place."""
        return bytes(self._buffer)


def _put(position: Place, value: float) -> None:
    where, which = position
    if isinstance(which, int):
        where[which] = value
    else:
        setattr(where, which, value)


def _find(data: bytes, mark: bytes) -> int:
    if data.count(mark) != 1:
        raise ValueError("a number cannot be found in the serialised message")
    return data.index(mark)


def axes(vector: Any, names: str = "xyz") -> list[Place]:
    """The places of a vector's or quaternion's components."""
    return [(vector, name) for name in names]
