"""Writes an MCAP file in chunks, in memory that does not grow with its length.

The `mcap` library packs the records. Its writer is not used: it holds the index of all chunks, megabytes an
hour, makes objects of every message, and takes messages only one by one.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from bota_clients.recording.disk_file import DiskFile
from bota_clients.recording.mcap_file import CHANNEL, HEADS, INDEX, MAGIC, MESSAGE, RECORD, RECORD_HEAD, Rows

_CHUNK: Final = 1024 * 1024  # bytes, before compression
_ENTRY: Final = struct.Struct("<QQ")  # of a message in a chunk: log time, position
_LENGTH: Final = slice(1, RECORD_HEAD)
_LOGGED: Final = slice(RECORD_HEAD + 6, RECORD_HEAD + 14)


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def _numbers(rows: Rows, place: slice) -> npt.NDArray[np.uint64]:
    return rows[:, place].copy().view("<u8")[:, 0]


def message_rows(channel: int, stamps_ns: npt.NDArray[np.int64], bodies: Rows, number: int) -> Rows:
    """Records of messages from stamps (n,) and bodies (n, b), numbered from `number` on."""
    made = np.zeros(len(bodies), [*HEADS, ("body", "u1", bodies.shape[1])])
    made["opcode"], made["length"], made["channel"] = Opcode.MESSAGE, MESSAGE.size + bodies.shape[1], channel
    made["number"], made["body"] = np.arange(number, number + len(bodies)), bodies
    made["logged"] = made["published"] = stamps_ns
    return made.view(np.uint8).reshape(len(made), made.itemsize)


class McapWriter:
    """A file that is being written; `flush` often: what was flushed can be read without what follows."""

    def __init__(self, disk: DiskFile, profile: str, library: str) -> None:
        self._disk, self._crc = disk, 0
        self._chunk, self._entries = bytearray(), defaultdict[int, bytearray](bytearray)  # by channel
        self._zstd = zstandard.ZstdCompressor()
        self._schemas, self._channels = dict[str, bytes](), list[bytes]()
        self._metadata = list[bytes]()  # their index
        self._chunks, self._counts = 0, Counter[int]()  # messages by channel
        self._first_ns = self._last_ns = 0
        self._write(MAGIC + _packed(Header(profile, library)))

    def metadata(self, name: str, notes: Mapping[str, str]) -> None:
        """Write a record of notes; what is in the chunk comes before it."""
        self._end_chunk()
        record = _packed(Metadata(name, dict(notes)))
        self._metadata.append(_packed(MetadataIndex(self._disk.tell(), len(record), name)))
        self._write(record)

    def channel(self, topic: str, schema: str, definition: str, **more: str) -> int:
        """A new channel for messages in CDR of this schema of ROS 2; its number."""
        if schema not in self._schemas:
            number = len(self._schemas) + 1
            made = Schema(data=definition.encode(), encoding="ros2msg", id=number, name=schema)
            self._schemas[schema] = _packed(made)
            self._chunk += self._schemas[schema]
        number, of = len(self._channels) + 1, [*self._schemas].index(schema) + 1
        self._channels.append(_packed(Channel(number, topic, "cdr", more, of)))
        self._chunk += self._channels[-1]
        return number

    def message(self, channel: int, stamp_ns: int, body: bytes, number: int) -> None:
        """Write one message."""
        self._entries[channel] += _ENTRY.pack(stamp_ns, len(self._chunk))
        self._chunk += RECORD.pack(Opcode.MESSAGE, MESSAGE.size + len(body))
        self._chunk += MESSAGE.pack(channel, number, stamp_ns, stamp_ns) + body
        if len(self._chunk) > _CHUNK:
            self._end_chunk()

    def messages(self, rows: Rows) -> None:
        """Write records of messages, with their heads, as `McapFile.rows` gives them."""
        ends = RECORD_HEAD + _numbers(rows, _LENGTH).astype(np.int64)
        positions = (np.cumsum(ends) - ends + len(self._chunk)).astype("<u8")
        entries = np.column_stack([_numbers(rows, _LOGGED), positions])
        channels = rows[:, CHANNEL].copy().view("<u2")[:, 0]
        for channel in np.unique(channels).tolist():
            self._entries[channel] += entries[channels == channel].tobytes()
        self._chunk += rows[np.arange(rows.shape[1]) < ends[:, np.newaxis]].tobytes()
        if len(self._chunk) > _CHUNK:
            self._end_chunk()

    def flush(self) -> None:
        """End the chunk and write it to disk."""
        self._end_chunk()
        self._disk.flush()

    def finish(self) -> None:
        """Write what is buffered, the index and the footer."""
        self._end_chunk()
        self._write(_packed(DataEnd(self._crc)))
        begin, self._crc, offsets = self._disk.tell(), 0, list[bytes]()
        for opcode, group in self._summary():
            start = self._disk.tell()
            for part in group:
                self._write(part)
                self._disk.flush()
            if length := self._disk.tell() - start:
                offsets.append(_packed(SummaryOffset(opcode, start, length)))
        footer = Footer(summary_start=begin, summary_offset_start=self._disk.tell(), summary_crc=0)
        self._write(b"".join(offsets))
        crc = zlib.crc32(_packed(footer)[:-4], self._crc)
        self._write(_packed(Footer(footer.summary_start, footer.summary_offset_start, crc)) + MAGIC)
        self._disk.flush()

    def _summary(self) -> Iterator[tuple[int, Iterable[bytes]]]:
        """Each group of records after the data, in parts."""
        statistics = Statistics(
            attachment_count=0, channel_count=len(self._channels), channel_message_counts=dict(self._counts),
            chunk_count=self._chunks, message_count=self._counts.total(), message_end_time=self._last_ns,
            message_start_time=self._first_ns, metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )  # fmt: skip
        yield Opcode.SCHEMA, self._schemas.values()
        yield Opcode.CHANNEL, self._channels
        yield Opcode.STATISTICS, [_packed(statistics)]
        yield Opcode.CHUNK_INDEX, self._disk.kept()
        yield Opcode.METADATA_INDEX, self._metadata

    def _end_chunk(self) -> None:
        """A chunk without messages is none: channels wait for the first."""
        if not self._entries:
            return
        data, entries = bytes(self._chunk), self._entries
        self._chunk, self._entries = bytearray(), defaultdict(bytearray)
        stamps = np.frombuffer(b"".join(entries.values()), "<u8")[::2]
        first_ns, last_ns, packed = int(stamps.min()), int(stamps.max()), self._zstd.compress(data)
        self._first_ns = min(first_ns, self._first_ns) if self._chunks else first_ns
        self._last_ns, self._chunks = max(last_ns, self._last_ns), self._chunks + 1
        begin = self._disk.tell()
        self._write(_packed(Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(data), len(data))))
        indexed, offsets = self._disk.tell(), dict[int, int]()
        for channel, each in entries.items():
            self._counts[channel] += len(each) // _ENTRY.size
            offsets[channel] = self._disk.tell()
            self._write(RECORD.pack(Opcode.MESSAGE_INDEX, INDEX.size + len(each)))
            self._write(INDEX.pack(channel, len(each)) + each)
        index = ChunkIndex(
            indexed - begin, begin, "zstd", len(packed), last_ns, self._disk.tell() - indexed, offsets,
            first_ns, len(data),
        )  # fmt: skip
        self._disk.keep(_packed(index))

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._disk.write(data)
