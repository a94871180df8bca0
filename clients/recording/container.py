"""The MCAP file below a recording: finds its chunks, checks them, gives the messages in them.

The `mcap` library reads files that were ended. This reads those that were cut off too, bounds everything
that a file can claim before it allocates for it, and checks every chunk's CRC.

Rules it keeps:

- Opening reads the heads of the records and no chunk but those that introduce a channel or have no index.
- What stands behind the last whole record of a file without an end is left out, and `cut_off` says so.
- Anything else that is not as it must be is a DamagedError that says where.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from clients.recording.chunk import HEAD_SIZE, MESSAGE, Chunk, records_in
from clients.recording.errors import DamagedError, NotARecordingError

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_SMALL_RECORD: Final = 1024 * 1024
"""Bytes of any other record that is read whole."""
MAX_CHANNELS: Final = 4096
MAX_CHUNKS: Final = 2_000_000
"""Ten days at two a second."""

_RECORD: Final = struct.Struct("<BQ")
_INDEX_HEAD: Final = struct.Struct("<HI")
_INDEX_ENTRY: Final = 16
_FOOTER: Final = struct.Struct("<BQQQI8s")
"""With the magic behind it: the last bytes of a file that was ended."""

_Record = TypeVar("_Record", Channel, Header, Metadata, Schema)


class RawMessage(NamedTuple):
    """A message as it stands in the file."""

    channel: int
    log_time_ns: int
    body: memoryview


class McapFile:
    """An open MCAP file.

    Attributes:
        profile: the profile in the file's header.
        metadata: the metadata records by name; of several with one name the last.
        channels: every channel that has messages, by its number.
        schemas: the schemas' texts and names.
        cut_off: None if the file was ended, else what is wrong with its end, as a clause.
    """

    def __init__(self, path: Path) -> None:
        """NotARecordingError if it is no MCAP file, DamagedError, OSError."""
        self.path = path
        self.profile = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.cut_off: str | None = None
        self._chunks: list[Chunk] = []
        self._file: BinaryIO = path.open("rb")
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._open()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def count(self, channel: int) -> int:
        """How many messages the channel has."""
        return sum(chunk.counts.get(channel, 0) for chunk in self._chunks)

    def messages(self, channels: Collection[int]) -> Iterator[RawMessage]:
        """The messages of these channels in the file's order; DamagedError at the first that is none."""
        wanted = frozenset(channels)
        for chunk in self._chunks:
            if not wanted.isdisjoint(chunk.counts):
                yield from self._messages_in(self._unpack(chunk), wanted, chunk.offset)

    # -- the file

    def _open(self) -> None:
        if self._file.read(len(MAGIC)) != MAGIC:
            raise NotARecordingError(f"{self.path} is not an MCAP file: a recording begins as one")
        # A file that was ended says so in its last bytes; what is wrong in it before is damage, not a cut.
        end = self._read_at(max(0, self._size - _FOOTER.size), _FOOTER.size)
        ended = len(end) == _FOOTER.size and end[0] == Opcode.FOOTER and end.endswith(MAGIC)
        position = len(MAGIC)
        while True:
            next_position = self._take_record(position, ended=ended)
            if next_position is None:
                break
            position = next_position
        if not self.profile and not self._chunks and not ended and position == len(MAGIC):
            raise NotARecordingError(f"{self.path} was cut off before anything was recorded")
        if not ended:
            left = self._size - position
            self.cut_off = (
                f"it has no end, {left} bytes of an unfinished part were left out"
                if left
                else "it has no end"
            )
            self._drop_damaged_tail()
        for chunk in self._chunks:
            self._learn(chunk)

    def _take_record(self, position: int, *, ended: bool) -> int | None:
        """Take the record at `position`; where the next one is, None at the end of what is to be read."""
        head = self._read_at(position, _RECORD.size)
        cut = not ended and (len(head) < _RECORD.size or head[0] == 0)
        if cut or (not head and position == self._size):
            return None
        if len(head) < _RECORD.size:
            raise self._damaged(position, "a record is not whole")
        length: int
        opcode, length = _RECORD.unpack(head)
        body = position + _RECORD.size
        end = body + length
        if end > self._size:
            if ended:
                raise self._damaged(position, f"a record claims {length} bytes")
            return None
        if opcode == Opcode.DATA_END:
            # What follows is a summary, which says again what was read already.
            return None
        if position == len(MAGIC) and opcode != Opcode.HEADER:
            raise NotARecordingError(f"{self.path} is not an MCAP file: it has no header")
        if opcode == Opcode.HEADER:
            self.profile = self._parse(Header, body, length).profile
        elif opcode == Opcode.METADATA:
            record = self._parse(Metadata, body, length)
            self.metadata[record.name] = record.metadata
        elif opcode == Opcode.CHUNK:
            if len(self._chunks) >= MAX_CHUNKS:
                raise self._damaged(position, f"it has more than {MAX_CHUNKS} chunks")
            self._chunks.append(self._chunk_at(body, length))
        elif opcode == Opcode.MESSAGE_INDEX:
            self._take_index(body, length)
        elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            raise NotARecordingError(f"{self.path} has messages outside of chunks: a recording has none")
        return end

    def _chunk_at(self, body: int, length: int) -> Chunk:
        try:
            return Chunk.of(self._read_at(body, min(length, HEAD_SIZE)), body, length)
        except ValueError as error:
            raise self._damaged(body, str(error)) from None

    def _take_index(self, body: int, length: int) -> None:
        try:
            channel, size = _INDEX_HEAD.unpack(self._read_at(body, _INDEX_HEAD.size))
        except struct.error:
            raise self._damaged(body, "an index is not whole") from None
        if not self._chunks or size + _INDEX_HEAD.size > length or size % _INDEX_ENTRY:
            raise self._damaged(body, "an index belongs to no chunk or is not whole")
        self._chunks[-1].counts[channel] = size // _INDEX_ENTRY

    def _drop_damaged_tail(self) -> None:
        # After a power failure the last blocks may be there but empty.
        while self._chunks:
            try:
                self._unpack(self._chunks[-1])
            except DamagedError:
                self._chunks.pop()
                self.cut_off = "it has no end, and its last part was damaged and left out"
                continue
            break

    # -- chunks

    def _learn(self, chunk: Chunk) -> None:
        """Get to know the channels of `chunk`, and count its messages if it has no index."""
        if chunk.counts and all(channel in self.channels for channel in chunk.counts):
            return
        counts: dict[int, int] = {}
        body = self._unpack(chunk)
        for opcode, start, end in self._records_in(body, chunk.offset):
            if opcode == Opcode.MESSAGE:
                (channel,) = struct.unpack_from("<H", body, start)
                counts[channel] = counts.get(channel, 0) + 1
            elif opcode == Opcode.SCHEMA:
                schema = self._parse_bytes(Schema, bytes(body[start:end]), chunk.offset)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                found = self._parse_bytes(Channel, bytes(body[start:end]), chunk.offset)
                self.channels[found.id] = found
            if len(self.schemas) + len(self.channels) > MAX_CHANNELS:
                raise self._damaged(chunk.offset, f"it has more than {MAX_CHANNELS} channels and schemas")
        chunk.counts.clear()
        chunk.counts.update(counts)
        for channel in counts:
            if channel not in self.channels:
                raise self._damaged(chunk.offset, f"a message is on channel {channel}, which there is not")

    def _unpack(self, chunk: Chunk) -> memoryview:
        try:
            return chunk.unpack(self._read_at(chunk.offset, chunk.packed_size))
        except ValueError as error:
            raise self._damaged(chunk.offset, str(error)) from None

    def _records_in(self, body: memoryview, offset: int) -> Iterator[tuple[int, int, int]]:
        return records_in(body, lambda what: self._damaged(offset, what))

    def _messages_in(self, body: memoryview, wanted: frozenset[int], offset: int) -> Iterator[RawMessage]:
        for opcode, start, end in self._records_in(body, offset):
            if opcode == Opcode.MESSAGE:
                channel, _, log_time_ns, _ = MESSAGE.unpack_from(body, start)
                if channel in wanted:
                    yield RawMessage(channel, log_time_ns, body[start + MESSAGE.size : end])

    # -- bytes

    def _read_at(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _parse(self, kind: type[_Record], offset: int, length: int) -> _Record:
        if length > MAX_SMALL_RECORD:
            raise self._damaged(offset, f"a record claims {length} bytes, more than {MAX_SMALL_RECORD}")
        return self._parse_bytes(kind, self._read_at(offset, length), offset)

    def _parse_bytes(self, kind: type[_Record], body: bytes, offset: int) -> _Record:
        try:
            record: _Record = kind.read(ReadDataStream(BytesIO(body)))
        except (McapError, struct.error, ValueError, OverflowError):
            raise self._damaged(offset, f"a {kind.__name__} cannot be read") from None
        return record

    def _damaged(self, offset: int, what: str) -> DamagedError:
        return DamagedError(f"{self.path} is damaged at byte {offset}: {what}")
