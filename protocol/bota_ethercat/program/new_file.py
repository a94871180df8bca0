# SPDX-License-Identifier: Apache-2.0
"""A text file that is written whole or not at all, and that replaces nothing without --force."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Final

from bota_ethercat.errors import FileError

EXISTS: Final = "exists: choose another name, or use --force to replace it"


def refuse_existing(path: Path, *, force: bool) -> None:
    """FileError if `path` is a file and not to be replaced; a device or a pipe may be written to."""
    try:
        exists = path.is_file()
    except OSError as error:  # of a folder that may not be searched, before Python 3.14
        raise FileError(f"{path} cannot be written: {error.strerror or error}") from None
    if exists and not force:
        raise FileError(f"{path} {EXISTS}")


# Of what a file system lacks: folders of VirtualBox, CIFS, WSL and 9P, NFS without its lock service, FUSE.
_LACKING: Final = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.ENOLCK}


@contextlib.contextmanager
def where_supported() -> Iterator[None]:
    """Go on without an operation that the file system lacks; its other errors are raised."""
    try:
        yield
    except OSError as error:
        if error.errno not in _LACKING:
            raise


class NewFile:
    """The file, opened before the work that fills it, so that it fails early. All raise FileError.

    A regular file appears, or is replaced, when it is complete; others, such as /dev/stdout, are written
    directly.
    """

    def __init__(self, path: Path, *, force: bool) -> None:
        self._path, self._force = path, force
        with self._errors():
            with contextlib.suppress(FileNotFoundError):
                path.stat()  # of other errors `exists` says nothing since Python 3.14
            refuse_existing(path, force=force)
            if path.exists() and not path.is_file():
                self._target = self._beside = path
            else:
                self._target = Path(os.path.realpath(path))  # a symbolic link stays one
                self._beside = self._target.with_name(f".unfinished-{os.urandom(4).hex()}")
            self._in_place = self._beside == self._target
            self._file = self._beside.open("w" if self._in_place else "x", encoding="utf-8", newline="\n")

    def write(self, text: str) -> None:
        """Add text."""
        with self._errors():
            self._file.write(text)

    def finish(self) -> None:
        """It is complete: on disk, and under its name."""
        with self._errors():
            self._file.flush()
            if not self._in_place:
                with where_supported():
                    os.fsync(self._file.fileno())
            self._file.close()  # first: some file systems rename no open file
            if not self._in_place:
                refuse_existing(self._path, force=self._force)
                self._beside.replace(self._target)
                with contextlib.suppress(OSError):  # it is there, complete
                    _sync_directory(self._target.parent)

    def close(self) -> None:
        """Discard what is not finished."""
        with contextlib.suppress(OSError):
            self._file.close()
        if not self._in_place:
            with contextlib.suppress(OSError):
                self._beside.unlink()

    def __enter__(self) -> NewFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise FileError(f"{self._path} cannot be written: {error.strerror or error}") from None


def _sync_directory(path: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):  # nor is it needed there
        return
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
