"""Writes an MCAP file: on disk in whole steps, in chunks, in memory that does not grow with its length.

The `mcap` library packs the records. Its writer is not used: it holds the index of all chunks, megabytes an
hour, makes objects of every message, and takes messages only one by one.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import tempfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Final

import numpy as np
import numpy.typing as npt
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from bota_clients.errors import RecordingError
from bota_clients.recording.mcap_file import HEAD, HEADS, INDEX, MAGIC, MESSAGE, RECORD, RECORD_HEAD, Rows
from bota_ethercat.program.new_file import EXISTS, refuse_existing, where_supported

try:
    import fcntl
except ImportError:  # Windows: it removes no open file, and has no such lock
    _LOCKS = False
else:
    _LOCKS = True

_BINARY: Final = getattr(os, "O_BINARY", 0)  # Windows would write other line ends
_CHUNK: Final = 1024 * 1024  # bytes, before compression
_ENTRY: Final = struct.Struct("<QQ")  # of a message in a chunk: log time, position


def _open_locked(path: Path, flags: int) -> int:
    """A descriptor of the file, which is locked until it is closed, and empty; OSError."""
    fd = os.open(path, flags, 0o666)
    try:
        if _LOCKS:
            with where_supported():
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(fd).st_size:
            os.ftruncate(fd, 0)
    except OSError as error:
        os.close(fd)
        if isinstance(error, BlockingIOError):
            raise OSError(error.errno, "another ethercat-record is writing to it") from None
        raise
    return fd


class DiskFile:
    """A new file for writing, of which a flush writes all or nothing.

    Attributes:
        removed: whether the file had no name any more when it was flushed last.
    """

    def __init__(self, path: Path, *, overwrite: bool, becomes: Path | None = None) -> None:
        """Create the file; RecordingError if that fails, or if it exists and `overwrite` is False.

        `becomes`: what it is renamed to once it is complete; nothing is left of it before.
        """
        self.path = becomes or path
        self._left = "" if becomes else "; what was written before is intact"
        self.removed = False
        self._waiting: list[bytes] = []
        self._position = self._written = 0  # with and without what is buffered
        flags = os.O_WRONLY | os.O_CREAT | _BINARY | (0 if overwrite else os.O_EXCL)
        try:
            self._fd = _open_locked(path, flags)
        except FileExistsError:
            raise RecordingError(f"{path} {EXISTS}") from None
        except OSError as error:
            raise self._failed(error) from None
        self._kept: IO[bytes] = io.BytesIO()
        with contextlib.suppress(OSError):  # some file systems remove no open file
            beside = path.parent if path.is_file() else None  # not that of a device
            self._kept = tempfile.TemporaryFile(dir=beside)  # noqa: SIM115 - see close
        self._counts_links = os.fstat(self._fd).st_nlink > 0  # some file systems do not

    def write(self, data: bytes) -> None:
        """Buffer `data` until the next flush."""
        self._waiting.append(data)
        self._position += len(data)

    def tell(self) -> int:
        return self._position

    def keep(self, data: bytes) -> None:
        """Hold for the end of the file, in another one without a name; RecordingError."""
        try:
            self._kept.write(data)
            self._kept.flush()
        except OSError as error:
            raise self._failed(error, self._left) from None

    def kept(self) -> Iterator[bytes]:
        """What was kept, in parts."""
        self._kept.seek(0)
        return iter(lambda: self._kept.read(1 << 16), b"")

    def flush(self) -> None:
        """Write what is buffered; RecordingError if that fails: then none of it is there, or no file."""
        data = memoryview(b"".join(self._waiting))
        self._waiting.clear()
        done = 0
        try:
            while done < len(data):
                done += os.write(self._fd, data[done:])
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._written)
                os.lseek(self._fd, self._written, os.SEEK_SET)
            self._position = self._written
            raise self._failed(error, self._left) from None
        self._written = self._position
        self.removed = self._counts_links and os.fstat(self._fd).st_nlink == 0
        if self.removed:
            raise RecordingError(f"{self.path} was removed while it was written: nothing of it is left")

    def sync(self) -> None:
        """Synchronize the file to the disk; RecordingError."""
        try:
            with where_supported():  # a pipe or a device has nothing to sync
                os.fsync(self._fd)
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Close the file; what is buffered is discarded."""
        with contextlib.suppress(OSError):  # it tries once more to write what a full disk did not take
            self._kept.close()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _failed(self, error: OSError, more: str = "") -> RecordingError:
        return RecordingError(f"{self.path} cannot be written: {error.strerror}{more}")


@contextlib.contextmanager
def moved_to(path: Path) -> Iterator[Path]:
    """A path beside this one for a file or a folder, which is moved here once it is complete."""
    with tempfile.TemporaryDirectory(
        prefix=".unfinished-", dir=path.parent, ignore_cleanup_errors=True
    ) as folder:
        made = Path(folder, path.name)
        yield made
        made.replace(path)


@contextlib.contextmanager
def whole_file(path: Path, *, force: bool) -> Iterator[DiskFile]:
    """A file that is there once it is complete, as `NewFile`; a device is written directly. FileError."""
    refuse_existing(path, force=force)
    if path.exists() and not path.is_file():
        with contextlib.closing(DiskFile(path, overwrite=True)) as disk:
            yield disk
        return
    with moved_to(Path(os.path.realpath(path))) as made:  # a symbolic link stays one
        with contextlib.closing(DiskFile(made, overwrite=False, becomes=path)) as disk:
            yield disk
        refuse_existing(path, force=force)


def _packed(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


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
        self._write(MAGIC + _packed(records.Header(profile, library)))

    def metadata(self, name: str, notes: Mapping[str, str]) -> None:
        """Write a record of notes, before what is not flushed."""
        record = _packed(records.Metadata(name, dict(notes)))
        self._metadata.append(_packed(records.MetadataIndex(self._disk.tell(), len(record), name)))
        self._write(record)

    def channel(self, topic: str, schema: str, definition: str, **more: str) -> int:
        """A new channel for messages in CDR of this schema of ROS 2; its number."""
        if schema not in self._schemas:
            number = len(self._schemas) + 1
            made = records.Schema(data=definition.encode(), encoding="ros2msg", id=number, name=schema)
            self._schemas[schema] = _packed(made)
            self._chunk += self._schemas[schema]
        number, of = len(self._channels) + 1, [*self._schemas].index(schema) + 1
        self._channels.append(_packed(records.Channel(number, topic, "cdr", more, of)))
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
        heads = rows[:, :HEAD].copy().view(np.dtype([*HEADS]))[:, 0]
        ends = RECORD_HEAD + heads["length"].astype("<u8")
        entries = np.column_stack([heads["logged"], np.cumsum(ends) - ends + np.uint64(len(self._chunk))])
        for channel in np.unique(heads["channel"]).tolist():
            self._entries[channel] += entries[heads["channel"] == channel].tobytes()
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
        self._write(_packed(records.DataEnd(self._crc)))
        begin, self._crc = self._disk.tell(), 0
        for part in self._summary():
            self._write(part)
            self._disk.flush()
        crc = zlib.crc32(_packed(records.Footer(begin, 0, 0))[:-4], self._crc)
        self._write(_packed(records.Footer(begin, 0, crc)) + MAGIC)
        self._disk.flush()

    def _summary(self) -> Iterator[bytes]:
        """The records after the data, in parts."""
        yield from [*self._schemas.values(), *self._channels]
        yield _packed(records.Statistics(
            attachment_count=0, channel_count=len(self._channels), channel_message_counts=dict(self._counts),
            chunk_count=self._chunks, message_count=self._counts.total(), message_end_time=self._last_ns,
            message_start_time=self._first_ns, metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        ))  # fmt: skip
        yield from self._disk.kept()
        yield from self._metadata

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
        self._write(_packed(records.Chunk("zstd", packed, last_ns, first_ns, zlib.crc32(data), len(data))))
        indexed, offsets = self._disk.tell(), dict[int, int]()
        for channel, each in entries.items():
            self._counts[channel] += len(each) // _ENTRY.size
            offsets[channel] = self._disk.tell()
            self._write(RECORD.pack(Opcode.MESSAGE_INDEX, INDEX.size + len(each)))
            self._write(INDEX.pack(channel, len(each)) + each)
        index = records.ChunkIndex(
            indexed - begin, begin, "zstd", len(packed), last_ns, self._disk.tell() - indexed, offsets,
            first_ns, len(data),
        )  # fmt: skip
        self._disk.keep(_packed(index))

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._disk.write(data)
