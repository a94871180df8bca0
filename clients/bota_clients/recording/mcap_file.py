"""The MCAP container of a recording: finds the chunks, checks them, yields their messages.

The `mcap` library parses the records. Its readers are not used to find them: StreamReader reads a whole file
before the first frame (25 times the time to open), takes a truncated record for a complete one, and allocates
whatever a zstd frame claims to hold.

- Opening reads record headers, and only those chunks that introduce a channel or have no message index.
- Messages outside of chunks, as other programs write them, are taken for chunks without compression.
- An incomplete record at the end of a file without a footer is ignored, and `cut_off` says so.
- Everything else that is malformed raises RecordingError with its position.
- Every length is checked against a limit before anything is allocated for it. Every CRC is verified.
"""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata

from bota_clients.errors import RecordingError
from bota_clients.numbers import count
from bota_clients.progress import progress
from bota_ethercat.text.untrusted import printable

MAGIC: Final = b"\x89MCAP0\r\n"
# Largest chunk in bytes, compressed or not. Those of ethercat-record have some hundred kilobytes.
MAX_CHUNK: Final = 64 * 1024 * 1024
MAX_CHUNKS: Final = 2_000_000  # ten days at two a second
MAX_METADATA: Final = 1024 * 1024  # bytes
MAX_CHANNELS: Final = 4096
_BARE: Final = 1024 * 1024  # bytes of messages outside of chunks that are taken for one

RECORD: Final = struct.Struct("<BQ")
_CHUNK: Final = struct.Struct("<QQQII")  # times, size and CRC without compression, length of its name
_U64: Final = struct.Struct("<Q")
MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_LOOK_AHEAD: Final = 512  # records
_SHORT: Final = 256  # bytes: longer ones than a frame
INDEX: Final = struct.Struct("<HI")  # channel, bytes that follow: 16 for each message
# With the trailing magic: the last bytes of a complete file.
_FOOTER_SIZE: Final = struct.calcsize("<BQQQI8s")
_UNREADABLE: Final = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError, RuntimeError)

_Counts = tuple[tuple[int, int], ...]
Rows = npt.NDArray[np.uint8]  # (n, bytes of each)
RECORD_HEAD: Final = RECORD.size
HEAD: Final = RECORD_HEAD + MESSAGE.size  # bytes before the body of a message
CHANNEL: Final = slice(RECORD_HEAD, RECORD_HEAD + 2)  # where a message has its channel
# The fields before the body.
HEADS: Final = (
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("number", "<u4"), ("logged", "<u8"),
    ("published", "<u8"),
)  # fmt: skip

_Record = TypeVar("_Record", Channel, Metadata)


def _alike(data: memoryview, position: int, stride: int) -> int:
    """How many records from `position` on have the same opcode and length."""
    most, count = (len(data) - position) // stride, 0
    head = bytes(data[position : position + RECORD_HEAD])
    if data[position + stride : position + stride + RECORD_HEAD] != head:
        return 1
    heads = np.frombuffer(data, np.uint8, most * stride, position).reshape(most, stride)[:, :RECORD_HEAD]
    while count < most:  # the cost of a look ahead is that of what it finds
        ahead = heads[count : 2 * count + _LOOK_AHEAD]
        if ahead.tobytes() != head * len(ahead):
            return count + int((ahead == heads[0]).all(axis=1).argmin())
        count += len(ahead)
    return count


def _padded(data: memoryview, records: list[tuple[int, int]]) -> Rows:
    """These records of different lengths, begin and end of each."""
    begin, end = np.array(records).T[:, :, np.newaxis]
    places = begin + np.arange((end - begin).max())
    rows: Rows = np.frombuffer(data, np.uint8).take(places, mode="clip")
    rows[places >= end] = 0
    return rows


def message_in(row: Rows) -> tuple[int, int, memoryview]:
    """Channel, log time (ns) and body of a message in its record."""
    data = memoryview(row.tobytes())
    _, length = RECORD.unpack_from(data)
    channel, _, log_time_ns, _ = MESSAGE.unpack_from(data, RECORD.size)
    return channel, log_time_ns, data[HEAD : RECORD.size + length]


class McapFile:
    """An open MCAP file. Use it as a context manager, or `close` it.

    Attributes:
        path: its path.
        notes: the metadata records by name; the last one of several with the same name.
        topics: of every channel that has messages, by its number.
        counts: the number of messages by channel.
        cut_off: None if the file is complete, else a clause that says how it ends.
    """

    def __init__(self, path: Path) -> None:
        """RecordingError if it cannot be read."""
        self.path = path
        self.notes: dict[str, dict[str, str]] = {}
        self.topics: dict[int, str] = {}
        self.counts = Counter[int]()
        self.cut_off: str | None = None
        # Of each chunk the position of its body, and messages by channel, a tuple for all that have the same:
        # hours have a hundred thousand chunks.
        self._chunks, self._counts = array("q"), list[_Counts]()
        self._known: dict[_Counts, _Counts] = {}
        self._bare: dict[int, int] = {}  # bytes of what is outside of chunks and taken for one
        self._zstd = zstandard.ZstdDecompressor()
        try:
            self._file = path.open("rb", buffering=0)
            try:
                self._size = os.fstat(self._file.fileno()).st_size
                self._open()
            except BaseException:
                self.close()
                raise
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from None

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def rows(self, channels: Collection[int]) -> Iterator[Rows]:
        """The records of messages, with their heads, in file order, of chunks that have these channels.

        Shorter ones are padded with zeros. RecordingError at the first corrupt chunk.
        """
        with progress(self.path.name, len(self._chunks)) as reach:
            for number, (chunk, counts) in enumerate(zip(self._chunks, self._counts, strict=True)):
                if any(channel in channels for channel, _ in counts):
                    for opcode, rows in self._records_in(chunk):
                        if opcode == Opcode.MESSAGE:
                            yield rows
                reach(number + 1)

    def _open(self) -> None:
        if self._file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{self.path} is not an MCAP file, so it is no recording")
        tail = self._read_at(max(0, self._size - _FOOTER_SIZE), _FOOTER_SIZE)
        has_footer = len(tail) == _FOOTER_SIZE and tail[0] == Opcode.FOOTER and tail.endswith(MAGIC)
        end, ended = self._scan()
        if has_footer and not ended:
            raise self._damaged(end, "a record is incomplete")
        if not has_footer:
            self._ignore_truncated_end(self._size - end)
        for number, counts in enumerate(self._counts):
            if not counts or any(channel not in self.topics for channel, _ in counts):
                self._counts[number] = counts = self._index_chunk(self._chunks[number])  # noqa: PLW2901
            self.counts.update(dict(counts))

    def _scan(self) -> tuple[int, bool]:
        """Take the records of the data section; the position behind the last, and whether its end is there.

        The summary that follows repeats what was read.
        """
        position = len(MAGIC)
        while len(head := self._read_at(position, RECORD.size)) == RECORD.size and head[0]:
            opcode, length = RECORD.unpack(head)
            body = position + RECORD.size
            if opcode == Opcode.DATA_END or body + length > self._size:
                return position, opcode == Opcode.DATA_END
            if (opcode == Opcode.HEADER) != (position == len(MAGIC)):
                raise RecordingError(f"{self.path} is not an MCAP file: its header is missing or repeated")
            self._index_record(opcode, body, length)
            position = body + length
        return position, False

    def _ignore_truncated_end(self, left: int) -> None:
        """It was cut off: ignore the `left` bytes of an incomplete record, and damaged chunks before them."""
        if left == self._size - len(MAGIC):
            raise RecordingError(f"{self.path} was cut off before anything was recorded")
        more = f", and the last {left} bytes, an incomplete record, were ignored" if left else ""
        there = len(self._chunks)
        while self._chunks:
            try:
                self._unpack(self._chunks[-1])
                break
            except RecordingError:  # after a power failure the last blocks of the file may be zeros
                del self._chunks[-1], self._counts[-1]
                more = f", and is read without {count(there - len(self._chunks), 'damaged chunk')} at its end"
        self.cut_off = f"it has no footer{more}"

    def _index_record(self, opcode: int, body: int, length: int) -> None:
        if opcode == Opcode.METADATA:
            self._bound(body, length, MAX_METADATA)
            record = self._parse(Metadata, self._read_at(body, length), body)
            self.notes[record.name] = record.metadata
        elif opcode == Opcode.CHUNK:
            self._add(body)
        elif opcode == Opcode.MESSAGE_INDEX:
            head = self._read_at(body, min(length, INDEX.size))
            channel, size = INDEX.unpack(head) if len(head) == INDEX.size else (0, -1)
            if not self._chunks or not 0 <= size <= length - INDEX.size or size % 16:
                raise self._damaged(body, "a message index is malformed or belongs to no chunk")
            counts = *self._counts[-1], (channel, size // 16)
            self._counts[-1] = self._known.setdefault(counts, counts)
        elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            begin, size = body - RECORD.size, RECORD.size + length
            last = self._bare.get(self._chunks[-1], 0) if self._chunks else 0
            if last and self._chunks[-1] + last == begin and last + size <= _BARE:
                self._bare[self._chunks[-1]] = last + size
            else:
                self._add(begin)
                self._bare[begin] = size

    def _add(self, chunk: int) -> None:
        if len(self._chunks) >= MAX_CHUNKS:
            raise self._damaged(chunk, f"it has more than {MAX_CHUNKS} chunks")
        self._chunks.append(chunk)
        self._counts.append(())

    def _index_chunk(self, chunk: int) -> _Counts:
        """Take the channels that a chunk introduces, and count its messages."""
        found = Counter[int]()
        for opcode, rows in self._records_in(chunk):
            if opcode == Opcode.MESSAGE:
                numbers, counts = np.unique(rows[:, CHANNEL].copy().view("<u2"), return_counts=True)
                found.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
            elif opcode == Opcode.CHANNEL:
                made = self._parse(Channel, memoryview(rows[0])[RECORD.size :], chunk)
                self.topics[made.id] = made.topic
                if len(self.topics) > MAX_CHANNELS:
                    raise self._damaged(chunk, f"it has more than {MAX_CHANNELS} channels")
        if unknown := found.keys() - self.topics.keys():
            raise self._damaged(chunk, f"a message is on channel {min(unknown)}, which does not exist")
        return tuple(found.items())

    def _records_in(self, chunk: int) -> Iterator[tuple[int, Rows]]:
        """Opcode and rows of every record in a chunk; messages that are alike, or short, many at once."""
        data = self._unpack(chunk)
        position, size = 0, len(data)
        short = list[tuple[int, int]]()  # begin and end
        while position < size:
            if position + RECORD.size > size:
                raise self._damaged(chunk, "a record in a chunk is incomplete")
            opcode, length = RECORD.unpack_from(data, position)
            stride = RECORD.size + length
            if stride > size - position or (opcode == Opcode.MESSAGE and length < MESSAGE.size):
                raise self._damaged(chunk, f"a record in a chunk claims {length} bytes")
            count = _alike(data, position, stride) if opcode == Opcode.MESSAGE else 1
            end = position + count * stride
            if opcode == Opcode.MESSAGE and count == 1 and stride <= _SHORT:
                short.append((position, end))
            else:
                if short:
                    yield Opcode.MESSAGE, _padded(data, short)
                    short.clear()
                yield opcode, np.frombuffer(data, np.uint8, end - position, position).reshape(count, stride)
            position = end
        if short:
            yield Opcode.MESSAGE, _padded(data, short)

    def _unpack(self, chunk: int) -> memoryview:
        """The decompressed records of a chunk."""
        if chunk in self._bare:
            self._bound(chunk, self._bare[chunk], MAX_CHUNK)
            return memoryview(self._read_at(chunk, self._bare[chunk]))
        (length,) = _U64.unpack(self._read_at(chunk - _U64.size, _U64.size))
        self._bound(chunk, length, MAX_CHUNK)
        body: Any = memoryview(self._file.read(length))
        try:  # the library's parser takes half as long as what is decompressed
            _, _, size, crc, named = _CHUNK.unpack_from(body)
            compression, data = str(body[_CHUNK.size :][:named], "utf-8"), body[_CHUNK.size + named :]
            data = data[8:][: _U64.unpack_from(data)[0]]
        except _UNREADABLE:
            raise self._damaged(chunk, "a Chunk record cannot be read") from None
        self._bound(chunk, size, MAX_CHUNK)
        try:
            if compression == "zstd":
                if zstandard.frame_content_size(data) not in (-1, size):
                    raise ValueError("its sizes differ")
                data = self._zstd.decompress(data, size)
            elif compression == "lz4":
                from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415 - mcap needs it, and few files

                data = LZ4FrameDecompressor().decompress(data, size + 1)
            elif compression:
                how = f"compressed with {printable(compression, 16)}, which is not read"
                raise RecordingError(f"{self.path} is {how}: write it again with zstd, or none")
            if crc not in (0, zlib.crc32(data)):
                raise ValueError("its checksum differs")
            if len(data) != size:
                raise ValueError(f"it has {len(data)} bytes instead of {size}")
            return memoryview(data)
        except _UNREADABLE as error:
            raise self._damaged(chunk, f"a chunk cannot be decompressed: {error}") from None

    def _read_at(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _parse(self, kind: type[_Record], body: bytes | memoryview, offset: int) -> _Record:
        try:
            record: _Record = kind.read(ReadDataStream(BytesIO(body)))
        except _UNREADABLE:
            raise self._damaged(offset, f"a {kind.__name__} record cannot be read") from None
        return record

    def _bound(self, offset: int, size: int, most: int) -> None:
        if size > most:
            raise self._damaged(offset, f"a record claims {size} bytes, more than {most}")

    def _damaged(self, offset: int, what: str) -> RecordingError:
        return RecordingError(f"{self.path} is damaged at byte {offset}: {what}")
