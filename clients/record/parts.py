"""The files of a recording: one, or with rotation several, `run_0.mcap`, `run_1.mcap`, ..."""

from __future__ import annotations

import re
import time
from pathlib import Path

from clients.errors import DiskError
from clients.recording.disk import DiskFile, remove
from protocol.program.new_file import EXISTS


class Parts:
    """Names and opens the files, and decides when to start the next."""

    def __init__(self, path: Path, *, size: int | None, seconds: float | None, overwrite: bool) -> None:
        """A new file after `size` bytes or `seconds`, whichever is first; one file if both are None."""
        self.path = path
        self.made: list[Path] = []
        self._size = size
        self._seconds = seconds
        self._overwrite = overwrite
        self._opened = 0.0

    @property
    def rotate(self) -> bool:
        """Whether there can be more than one."""
        return self._size is not None or self._seconds is not None

    def check(self) -> None:
        """DiskError if a file exists and may not be overwritten, or the folder does not exist."""
        if not self.path.parent.is_dir():
            raise DiskError(f"{self.path} cannot be created: there is no folder {self.path.parent}")
        if self.path.is_dir():
            raise DiskError(f"{self.path} is a folder: name a file in it")
        found = self._existing()
        if found and not self._overwrite:
            raise DiskError(f"{found[0]} {EXISTS}")

    def open(self) -> DiskFile:
        """The next file; DiskError."""
        if not self.made and self.rotate:
            # Leftover files of an older, longer recording would seem to belong to this one.
            remove(self._existing())
        path = self._part(len(self.made)) if self.rotate else self.path
        disk = DiskFile(path, overwrite=self._overwrite)
        self.made.append(path)
        self._opened = time.monotonic()
        return disk

    def is_full(self, size: int) -> bool:
        """Whether the file, of `size` bytes, is full."""
        full = self._size is not None and size >= self._size
        return full or (self._seconds is not None and time.monotonic() - self._opened >= self._seconds)

    def _part(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.stem}_{number}{self.path.suffix}")

    def _existing(self) -> list[Path]:
        if not self.rotate:
            return [self.path] if self.path.exists() else []
        name = re.compile(f"{re.escape(self.path.stem)}_[0-9]+{re.escape(self.path.suffix)}", re.ASCII)
        return sorted(path for path in self.path.parent.iterdir() if name.fullmatch(path.name))
