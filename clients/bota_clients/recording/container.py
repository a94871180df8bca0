"""The MCAP container of a recording: finds the chunks, checks them, yields their messages.

The `mcap` library parses the records and decompresses the chunks. Its readers are not used to find them:
StreamReader reads a whole file before the first frame (25 times the time to open), takes a truncated record
for a complete one, and allocates whatever a zstd frame claims to hold.

- Opening reads record headers, and only those chunks that introduce a channel or have no message index.
- An incomplete record at the end of a file without a footer is ignored, and `cut_off` says so.
- Everything else that is malformed raises DamagedError with its position.
- Every length is checked against a limit before anything is allocated for it. Every CRC is verified.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from bota_clients.errors import DamagedError, NotARecordingError

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_CHUNK: Final = 64 * 1024 * 1024
"""Largest chunk in bytes, compressed or not. Those of ethercat-record have some hundred kilobytes."""
MAX_SMALL_RECORD: Final = 1024 * 1024
"""Largest size in bytes of any other record that is read whole."""
MAX_CHANNELS: Final = 4096
MAX_CHUNKS: Final = 2_000_000
"""Ten days at two a second."""

_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
"""Head of a message record: channel, sequence, log time, publish time."""
_INDEX_HEAD: Final = struct.Struct("<HI")
_INDEX_ENTRY: Final = 16
_FOOTER_SIZE: Final = struct.calcsize("<BQQQI8s")
"""Footer record and trailing magic: the last bytes of a complete file."""
_UNREADABLE: Final = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError)

_Record = TypeVar("_Record", Channel, Chunk, Header, Metadata, Schema)


class RawMessage(NamedTuple):
    """A message as it stands in the file."""

    channel: int
    log_time_ns: int
    body: memoryview


class _ChunkRecord(NamedTuple):
    """The body of a chunk record in the file, and its number of messages by channel."""

    offset: int
    length: int
    counts: dict[int, int]


class McapFile:
    """An open MCAP file.

    Attributes:
        profile: the profile in the file's header.
        metadata: the metadata records by name; the last one of several with the same name.
        channels: every channel that has messages, by its number.
        schemas: the schemas, by number.
        cut_off: None if the file is complete, else a clause that says how it ends.
    """

    def __init__(self, path: Path) -> None:
        """NotARecordingError if it is no MCAP file, DamagedError, OSError."""
        self.path = path
        self.profile = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.cut_off: str | None = None
        self._chunks: list[_ChunkRecord] = []
        self._file: BinaryIO = path.open("rb")
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._scan()
            for chunk in self._chunks:
                self._learn(chunk)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def count(self, channel: int) -> int:
        """Number of messages on the channel."""
        return sum(chunk.counts.get(channel, 0) for chunk in self._chunks)

    def messages(self, channels: Collection[int]) -> Iterator[RawMessage]:
        """The messages of these channels in file order; DamagedError at the first corrupt chunk."""
        wanted = frozenset(channels)
        for chunk in self._chunks:
            if wanted.isdisjoint(chunk.counts):
                continue
            data = self._unpack(chunk)
            for opcode, start, end in self._records_in(data, chunk):
                if opcode == Opcode.MESSAGE:
                    channel, _, log_time_ns, _ = _MESSAGE.unpack_from(data, start)
                    if channel in wanted:
                        yield RawMessage(channel, log_time_ns, data[start + _MESSAGE.size : end])

    # -- the file

    def _scan(self) -> None:
        if self._file.read(len(MAGIC)) != MAGIC:
            raise NotARecordingError(f"{self.path} is not an MCAP file, so it is no recording")
        tail = self._read_at(max(0, self._size - _FOOTER_SIZE), _FOOTER_SIZE)
        complete = len(tail) == _FOOTER_SIZE and tail[0] == Opcode.FOOTER and tail.endswith(MAGIC)
        position = len(MAGIC)
        while (record := self._record_at(position, complete=complete)) is not None:
            opcode, body, length = record
            if (opcode == Opcode.HEADER) != (position == len(MAGIC)):
                raise NotARecordingError(
                    f"{self.path} is not an MCAP file: its header is missing or repeated"
                )
            self._take(opcode, body, length)
            position = body + length
        if complete:
            return
        if position == len(MAGIC):
            raise NotARecordingError(f"{self.path} was cut off before anything was recorded")
        left = self._size - position
        self.cut_off = "it has no footer" + (
            f", and the last {left} bytes, an incomplete record, were ignored" if left else ""
        )
        # After a power failure the last blocks of the file may be zeros.
        while self._chunks and not self._is_sound(self._chunks[-1]):
            self._chunks.pop()
            self.cut_off = "it has no footer, and its last chunk, which is damaged, was ignored"

    def _record_at(self, position: int, *, complete: bool) -> tuple[int, int, int] | None:
        """Opcode, position of the body and length of a record; None at the end of the data section."""
        head = self._read_at(position, _RECORD.size)
        if len(head) < _RECORD.size or (head[0] == 0 and not complete):
            if complete:
                raise self._damaged(position, "a record is incomplete")
            return None
        opcode, length = _RECORD.unpack(head)
        if opcode == Opcode.DATA_END:
            return None  # the summary that follows repeats what was read
        body = position + _RECORD.size
        if body + length > self._size:
            if complete:
                raise self._damaged(position, f"a record claims {length} bytes")
            return None
        return opcode, body, length

    def _take(self, opcode: int, body: int, length: int) -> None:
        if opcode == Opcode.HEADER:
            self.profile = self._parse(Header, self._small(body, length), body).profile
        elif opcode == Opcode.METADATA:
            record = self._parse(Metadata, self._small(body, length), body)
            self.metadata[record.name] = record.metadata
        elif opcode == Opcode.CHUNK:
            if len(self._chunks) >= MAX_CHUNKS:
                raise self._damaged(body, f"it has more than {MAX_CHUNKS} chunks")
            self._chunks.append(_ChunkRecord(body, length, {}))
        elif opcode == Opcode.MESSAGE_INDEX:
            head = self._read_at(body, min(length, _INDEX_HEAD.size))
            channel, size = _INDEX_HEAD.unpack(head) if len(head) == _INDEX_HEAD.size else (0, -1)
            if not self._chunks or not 0 <= size <= length - _INDEX_HEAD.size or size % _INDEX_ENTRY:
                raise self._damaged(body, "a message index is malformed or belongs to no chunk")
            self._chunks[-1].counts[channel] = size // _INDEX_ENTRY
        elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            raise NotARecordingError(f"{self.path} has messages outside of chunks: it is no recording")

    # -- chunks

    def _learn(self, chunk: _ChunkRecord) -> None:
        """Read the channels that `chunk` introduces, and count its messages if it has no index."""
        if chunk.counts and all(channel in self.channels for channel in chunk.counts):
            return
        chunk.counts.clear()
        data = self._unpack(chunk)
        for opcode, start, end in self._records_in(data, chunk):
            if opcode == Opcode.MESSAGE:
                channel = int.from_bytes(data[start : start + 2], "little")
                chunk.counts[channel] = chunk.counts.get(channel, 0) + 1
            elif opcode == Opcode.SCHEMA:
                schema = self._parse(Schema, data[start:end], chunk.offset)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                found = self._parse(Channel, data[start:end], chunk.offset)
                self.channels[found.id] = found
            if len(self.schemas) + len(self.channels) > MAX_CHANNELS:
                raise self._damaged(chunk.offset, f"it has more than {MAX_CHANNELS} channels and schemas")
        for channel in chunk.counts:
            if channel not in self.channels:
                raise self._damaged(chunk.offset, f"a message is on channel {channel}, which does not exist")

    def _is_sound(self, chunk: _ChunkRecord) -> bool:
        try:
            self._unpack(chunk)
        except DamagedError:
            return False
        return True

    def _unpack(self, chunk: _ChunkRecord) -> memoryview:
        """The decompressed records of a chunk."""
        if chunk.length > MAX_CHUNK:
            raise self._damaged(chunk.offset, f"a chunk claims {chunk.length} bytes, more than {MAX_CHUNK}")
        found = self._parse(Chunk, self._read_at(chunk.offset, chunk.length), chunk.offset)
        size = found.uncompressed_size
        if size > MAX_CHUNK:
            raise self._damaged(chunk.offset, f"a chunk claims {size} bytes, more than {MAX_CHUNK}")
        if found.compression not in ("", "zstd"):
            raise self._damaged(
                chunk.offset, f"a chunk is compressed with {found.compression[:16]!r}, not zstd"
            )
        try:
            if found.compression and zstandard.frame_content_size(found.data) not in (-1, size):
                raise ValueError("its sizes differ")
            stream, got = get_chunk_data_stream(found, validate_crc=True)
            if got != size:
                raise ValueError(f"it has {got} bytes instead of {size}")
            return memoryview(stream.read(size))
        except _UNREADABLE as error:
            raise self._damaged(chunk.offset, f"a chunk cannot be decompressed: {error}") from None

    def _records_in(self, data: memoryview, chunk: _ChunkRecord) -> Iterator[tuple[int, int, int]]:
        """Opcode, start and end of every record in a chunk."""
        position, size = 0, len(data)
        while position < size:
            if position + _RECORD.size > size:
                raise self._damaged(chunk.offset, "a record in a chunk is incomplete")
            opcode, length = _RECORD.unpack_from(data, position)
            position += _RECORD.size
            if length > size - position or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
                raise self._damaged(chunk.offset, f"a record in a chunk claims {length} bytes")
            yield opcode, position, position + length
            position += length

    # -- bytes

    def _read_at(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _small(self, offset: int, length: int) -> bytes:
        if length > MAX_SMALL_RECORD:
            raise self._damaged(offset, f"a record claims {length} bytes, more than {MAX_SMALL_RECORD}")
        return self._read_at(offset, length)

    def _parse(self, kind: type[_Record], body: bytes | memoryview, offset: int) -> _Record:
        try:
            record: _Record = kind.read(ReadDataStream(BytesIO(body)))
        except _UNREADABLE:
            raise self._damaged(offset, f"a {kind.__name__} record cannot be read") from None
        return record

    def _damaged(self, offset: int, what: str) -> DamagedError:
        return DamagedError(f"{self.path} is damaged at byte {offset}: {what}")
