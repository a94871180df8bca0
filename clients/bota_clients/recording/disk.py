"""The file on disk: what was flushed stays intact, whatever happens to the process or the disk.

A flush writes complete MCAP records. If the disk takes only a part of them, the file is truncated again.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from bota_clients.errors import DiskError
from bota_ethercat.program.new_file import EXISTS

_LOCKS = True
try:
    import fcntl
except ImportError:  # Windows: it removes no open file, and has no such lock
    _LOCKS = False

_BINARY: Final = getattr(os, "O_BINARY", 0)
"""Windows would write other line ends."""


def _lock(fd: int) -> None:
    """Lock the file until it is closed; OSError."""
    if not _LOCKS:
        return
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(error.errno, "another ethercat-record is writing to it") from None


def remove(paths: Sequence[Path]) -> None:
    """Remove these files, or none if one of them is in use (on Windows, those before it); DiskError."""
    for really in (False, True):
        for path in paths:
            try:
                with _locked(path):
                    if really:
                        path.unlink()
            except OSError as error:
                raise DiskError(f"{path} cannot be replaced: {error.strerror}") from None


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    if not _LOCKS:
        yield
        return
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        _lock(fd)
        yield
    finally:
        os.close(fd)


class DiskFile:
    """A new file for writing, with the part of a binary file's interface that `mcap.writer.Writer` needs.

    Attributes:
        removed: whether the file had no name any more when it was flushed last.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        """Create the file; DiskError if that fails, or if it exists and `overwrite` is False."""
        self.path = path
        self.removed = False
        self._waiting: list[bytes] = []
        self._position = 0
        """Including what is buffered."""
        self._written = 0
        try:
            self._fd = os.open(
                path, os.O_WRONLY | os.O_CREAT | (0 if overwrite else os.O_EXCL) | _BINARY, 0o666
            )
        except FileExistsError:
            raise DiskError(f"{path} {EXISTS}") from None
        except OSError as error:
            raise DiskError(f"{path} cannot be created: {error.strerror}") from None
        try:
            _lock(self._fd)
            os.ftruncate(self._fd, 0)
        except OSError as error:
            os.close(self._fd)
            raise DiskError(f"{path} cannot be written: {error.strerror}") from None

    def write(self, data: bytes) -> int:
        """Buffer `data` until the next flush."""
        if data:
            self._waiting.append(bytes(data))
            self._position += len(data)
        return len(data)

    def tell(self) -> int:
        """Position of the next byte."""
        return self._position

    def flush(self) -> None:
        """Write what is buffered; DiskError if that fails, and then none of it is in the file, or no file."""
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
            raise DiskError(
                f"{self.path} cannot be written: {error.strerror}; what was written before is intact"
            ) from None
        self._written = self._position
        self.removed = os.fstat(self._fd).st_nlink == 0
        if self.removed:
            raise DiskError(f"{self.path} was removed while it was written: nothing of it is left")

    def sync(self) -> None:
        """Synchronize the file to the disk; DiskError."""
        try:
            os.fsync(self._fd)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a pipe or a device has nothing to sync
                raise DiskError(f"{self.path} cannot be written: {error.strerror}") from None

    def close(self) -> None:
        """Close the file; what is buffered is discarded."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
