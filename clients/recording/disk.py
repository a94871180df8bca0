"""The file on disk: what was once flushed stays whole, whatever happens to the process or the disk.

A flush is one write of whole MCAP records. If the disk takes only a part of it, that part is taken off again.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Sequence
from pathlib import Path

from clients.recording.errors import DiskError


def _lock(fd: int) -> None:
    """Have it for us alone, until it is closed; OSError."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(error.errno, "another ethercat-record is writing to it") from None


def remove(paths: Sequence[Path]) -> None:
    """Remove these files, or none of them if one is being written; DiskError."""
    for really in (False, True):
        for path in paths:
            try:
                fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
                try:
                    _lock(fd)
                    if really:
                        path.unlink()
                finally:
                    os.close(fd)
            except OSError as error:
                raise DiskError(f"{path} cannot be replaced: {error.strerror}") from None


class DiskFile:
    """A new file for writing; has as much of a binary file as `mcap.writer.Writer` needs."""

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        """Make the file; DiskError if it cannot be, or is there already and `overwrite` is False."""
        self.path = path
        self._waiting: list[bytes] = []
        self._position = 0
        """With what waits."""
        self._written = 0
        try:
            self._fd = os.open(
                path, os.O_WRONLY | os.O_CREAT | (0 if overwrite else os.O_EXCL) | os.O_CLOEXEC, 0o666
            )
        except FileExistsError:
            raise DiskError(f"{path} exists: choose another name, or --force to replace it") from None
        except OSError as error:
            raise DiskError(f"{path} cannot be made: {error.strerror}") from None
        try:
            _lock(self._fd)
            os.truncate(self._fd, 0)
        except OSError as error:
            os.close(self._fd)
            raise DiskError(f"{path} cannot be written: {error.strerror}") from None

    def write(self, data: bytes) -> int:
        """Have `data` wait for the next flush."""
        if data:
            self._waiting.append(bytes(data))
            self._position += len(data)
        return len(data)

    def tell(self) -> int:
        """Where the next byte goes."""
        return self._position

    def flush(self) -> None:
        """Write what waits; DiskError if not all of it can be, and then none of it is there."""
        data = memoryview(b"".join(self._waiting))
        self._waiting.clear()
        done = 0
        try:
            while done < len(data):
                done += os.pwrite(self._fd, data[done:], self._written + done)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.truncate(self._fd, self._written)
            self._position = self._written
            raise DiskError(f"{self.path} cannot be written: {error.strerror}") from None
        self._written = self._position

    def sync(self) -> None:
        """Have the disk itself keep what was written; DiskError if it cannot."""
        try:
            os.fsync(self._fd)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a pipe or a device has nothing to sync
                raise DiskError(f"{self.path} cannot be written: {error.strerror}") from None

    def close(self) -> None:
        """Close the file; what waits is not written."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
