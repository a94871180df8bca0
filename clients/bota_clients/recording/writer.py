"""Writes one recording file: frames, descriptions and events as MCAP messages.

What was flushed stays intact, whatever happens to the process or the disk: a flush writes complete MCAP
records, and if the disk takes only a part of them, the file is truncated again. Not thread-safe.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Final, cast

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from bota_clients.errors import RecordingError
from bota_clients.recording import file_format
from bota_ethercat.framing import DataMessage
from bota_ethercat.program.new_file import EXISTS, refuse_existing, where_supported
from bota_ethercat.text.json_text import JsonObject

try:
    import fcntl
except ImportError:  # Windows: it removes no open file, and has no such lock
    _LOCKS = False
else:
    _LOCKS = True

_BINARY: Final = getattr(os, "O_BINARY", 0)  # Windows would write other line ends
_CHUNK_SIZE: Final = 1024 * 1024
_U32: Final = 0xFFFFFFFF


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
    """A new file for writing, with the part of a binary file's interface that `mcap.writer.Writer` needs.

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
        self._counts_links = os.fstat(self._fd).st_nlink > 0  # some file systems do not

    def write(self, data: bytes) -> int:
        """Buffer `data` until the next flush."""
        self._waiting.append(bytes(data))
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Write what is buffered; RecordingError if that fails: then none of it is there, or no file."""
        data = memoryview(b"".join(self._waiting))
        self._waiting.clear()
        done = 0
        try:
            os.lseek(self._fd, self._written, os.SEEK_SET)
            while done < len(data):
                done += os.write(self._fd, data[done:])
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._written)
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
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _failed(self, error: OSError, more: str = "") -> RecordingError:
        return RecordingError(f"{self.path} cannot be written: {error.strerror}{more}")


@contextlib.contextmanager
def whole_file(path: Path, *, force: bool) -> Iterator[DiskFile]:
    """A file that is there once it is complete, as `NewFile`; a device is written directly. FileError."""
    refuse_existing(path, force=force)
    if path.exists() and not path.is_file():
        with contextlib.closing(DiskFile(path, overwrite=True)) as disk:
            yield disk
        return
    target = Path(os.path.realpath(path))  # a symbolic link stays one
    with tempfile.TemporaryDirectory(
        prefix=".unfinished-", dir=target.parent, ignore_cleanup_errors=True
    ) as folder:
        made = Path(folder, target.name)
        with contextlib.closing(DiskFile(made, overwrite=False, becomes=path)) as disk:
            yield disk
        refuse_existing(path, force=force)
        made.replace(target)


class _Index(list[Any]):
    """The index of the chunks as bytes, a megabyte an hour; the library's objects take five times as much."""

    def __init__(self) -> None:
        self._packed = RecordBuilder()

    def append(self, each: ChunkIndex) -> None:
        each.write(self._packed)

    def __iter__(self) -> Iterator[_Index]:
        yield self

    def write(self, summary: RecordBuilder) -> None:
        summary.write(self._packed.end())  # type: ignore[no-untyped-call]


class RecordingWriter:
    """A recording file that is being written. Call `flush` often: what was flushed survives this process.

    Attributes:
        frames: number of frames written.
    """

    def __init__(self, disk: DiskFile, library: str, notes: Mapping[str, str]) -> None:
        """Start the file: `notes` become its metadata."""
        self.frames = 0
        self._disk = disk
        stream = cast("IO[Any]", disk)
        self._mcap = Writer(stream, _CHUNK_SIZE, CompressionType.ZSTD, enable_data_crcs=True)
        self._mcap._Writer__chunk_indices = _Index()  # type: ignore[attr-defined]
        self._mcap.start(file_format.PROFILE, library)
        self._mcap.add_metadata(file_format.METADATA, {"format": file_format.FORMAT_VERSION, **notes})
        self._schemas: dict[str, int] = {}
        self._descriptions = self._channel(file_format.DESCRIPTION_TOPIC, file_format.TEXT_SCHEMA)
        self._events = self._channel(file_format.EVENTS_TOPIC, file_format.TEXT_SCHEMA)
        self._notes = 0
        self._frame_channels: dict[int, int] = {}

    def describe(self, stamp_ns: int, description: JsonObject) -> None:
        self._note(self._descriptions, stamp_ns, description)

    def event(self, stamp_ns: int, event: JsonObject) -> None:
        """Write an event received at `stamp_ns`."""
        self._note(self._events, stamp_ns, event)

    def frame(self, frame: DataMessage) -> None:
        channel = self._frame_channels.get(frame.sensor)
        if channel is None:
            channel = self._channel(file_format.frame_topic(frame.sensor), file_format.FRAME_SCHEMA)
            self._frame_channels[frame.sensor] = channel
        stamp_ns = frame.stamp_ns
        self._mcap.add_message(
            channel, stamp_ns, file_format.pack_frame(frame), stamp_ns, frame.sequence & _U32
        )
        self.frames += 1

    def flush(self) -> None:
        """End the chunk and write it to disk; RecordingError if it cannot be written."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def finish(self, notes: Mapping[str, str] | None) -> None:
        """Write what is buffered, `notes`, index and footer, synchronize the disk, close; RecordingError."""
        self.flush()
        if notes is not None:
            self._mcap.add_metadata(file_format.END_METADATA, dict(notes))
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._disk.flush()
        self._disk.sync()
        self._disk.close()

    def _note(self, channel: int, stamp_ns: int, message: JsonObject) -> None:
        self._mcap.add_message(channel, stamp_ns, file_format.pack_json(message), stamp_ns, self._notes)
        self._notes += 1

    def _channel(self, topic: str, schema: str) -> int:
        if schema not in self._schemas:
            definition = file_format.DEFINITIONS[schema].encode()
            self._schemas[schema] = self._mcap.register_schema(
                schema, file_format.SCHEMA_ENCODING, definition
            )
        # An empty profile: `ros2 bag play` uses its own, which is reliable, as the node's is.
        profiles = {"offered_qos_profiles": ""}
        return self._mcap.register_channel(topic, file_format.ENCODING, self._schemas[schema], profiles)
