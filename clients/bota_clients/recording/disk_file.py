"""A new file on disk: written in whole steps, whatever happens to the process or the disk."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from bota_clients.errors import RecordingError
from bota_ethercat.program.new_file import EXISTS, refuse_existing, where_supported

try:
    import fcntl
except ImportError:  # Windows: it removes no open file, and has no such lock
    _LOCKS = False
else:
    _LOCKS = True

_BINARY: Final = getattr(os, "O_BINARY", 0)  # Windows would write other line ends
_KEPT_IN_MEMORY: Final = 1024 * 1024  # bytes
_AT_ONCE: Final = 64 * 1024  # bytes


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
        beside = str(path.parent) if path.is_file() else None  # not that of a device
        self._kept = tempfile.SpooledTemporaryFile(_KEPT_IN_MEMORY, dir=beside)  # noqa: SIM115 - see close
        self._counts_links = os.fstat(self._fd).st_nlink > 0  # some file systems do not

    def write(self, data: bytes) -> None:
        """Buffer `data` until the next flush."""
        self._waiting.append(data)
        self._position += len(data)

    def tell(self) -> int:
        return self._position

    def keep(self, data: bytes) -> None:
        """Hold for the end of the file, on disk if it is much; RecordingError."""
        try:
            self._kept.write(data)
        except OSError as error:
            raise self._failed(error, self._left) from None

    def kept(self) -> Iterator[bytes]:
        """What was kept, in parts."""
        self._kept.seek(0)
        return iter(lambda: self._kept.read(_AT_ONCE), b"")

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
        self._kept.close()
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
