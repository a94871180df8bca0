"""One chunk of an MCAP file: its data taken out of the packing and checked, and the records in it.

What a chunk claims is compared with bounds and with what is there before anything is allocated for it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from clients.recording.errors import DamagedError

MAX_CHUNK: Final = 64 * 1024 * 1024
"""Bytes of a chunk, packed or unpacked. Ours have some hundred kilobytes."""

_HEAD: Final = struct.Struct("<QQQII")
_U64: Final = struct.Struct("<Q")
_LONGEST_NAME: Final = 16
HEAD_SIZE: Final = _HEAD.size + _LONGEST_NAME + _U64.size
"""So many bytes of a chunk are enough for `Chunk.of`."""
_RECORD: Final = struct.Struct("<BQ")
MESSAGE: Final = struct.Struct("<HIQQ")
"""The head of a message record: channel, sequence, log time, publish time."""
_COMPRESSIONS: Final = ("", "lz4", "zstd")


class Chunk(NamedTuple):
    """Where a chunk is and what it claims."""

    offset: int
    """Where its packed data begins."""
    packed_size: int
    size: int
    crc: int
    compression: str
    counts: dict[int, int]
    """Messages in it by channel; filled in while the file is walked."""

    @classmethod
    def of(cls, head: bytes, body: int, length: int) -> Chunk:
        """The chunk whose record body, `length` bytes at `body`, begins with `head`.

        ValueError says what is wrong with it.
        """
        try:
            _, _, size, crc, name_length = _HEAD.unpack_from(head)
            name_end = _HEAD.size + min(name_length, _LONGEST_NAME)
            (packed,) = _U64.unpack_from(head, name_end)
        except struct.error:
            raise ValueError("a chunk's head is not whole") from None
        name = head[_HEAD.size : name_end].decode("ascii", "replace")
        if name not in _COMPRESSIONS or len(name) != name_length:
            raise ValueError(f"a chunk is compressed with {name!r}: zstd and lz4 are known")
        if max(size, packed) > MAX_CHUNK:
            raise ValueError(f"a chunk claims {max(size, packed)} bytes, more than {MAX_CHUNK}")
        offset = body + name_end + _U64.size
        if offset + packed > body + length:
            raise ValueError("a chunk claims more data than it has")
        return cls(offset, packed, size, crc, name, {})

    def unpack(self, packed: bytes) -> memoryview:
        """Its data; ValueError says what is wrong with it."""
        try:
            if self.compression == "zstd":
                # The library would allocate whatever the data claims.
                if zstandard.frame_content_size(packed) not in (-1, self.size):
                    raise ValueError("a chunk's size contradicts itself")
                data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=self.size)
            elif self.compression == "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=self.size)
            else:
                data = packed
        except (zstandard.ZstdError, RuntimeError, EOFError):
            raise ValueError("a chunk cannot be decompressed") from None
        if len(data) != self.size:
            raise ValueError(f"a chunk has {len(data)} bytes and claims {self.size}")
        if self.crc and zlib.crc32(data) != self.crc:
            raise ValueError("a chunk's CRC is wrong")
        return memoryview(data)


def records_in(body: memoryview, damaged: Callable[[str], DamagedError]) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the body of every record in a chunk's data; raises what `damaged` makes."""
    position, size = 0, len(body)
    while position < size:
        if position + _RECORD.size > size:
            raise damaged("a record in a chunk is not whole")
        opcode, length = _RECORD.unpack_from(body, position)
        position += _RECORD.size
        if length > size - position or (opcode == Opcode.MESSAGE and length < MESSAGE.size):
            raise damaged(f"a record in a chunk claims {length} bytes")
        yield opcode, position, position + length
        position += length
