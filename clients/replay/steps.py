"""Stepping: a line on standard input lets one frame go, a number lets so many go."""

from __future__ import annotations

import os
import select
from typing import Final

_MOST: Final = 1_000_000
_LINE: Final = 4096


class Steps:
    """How many frames may go out."""

    def __init__(self, fd: int) -> None:
        """Read lines from the file descriptor `fd`."""
        self._fd = fd
        self._left = 0
        self._pending = b""
        self._open = True

    @property
    def ended(self) -> bool:
        """Whether there is nobody left who could let a frame go."""
        return self._left == 0 and not self._open

    def take(self) -> bool:
        """Whether the next frame may go; it counts as gone then. Never waits."""
        if self._left == 0 and self._open and select.select((self._fd,), (), (), 0)[0]:
            self._read()
        if self._left == 0:
            return False
        self._left -= 1
        return True

    def _read(self) -> None:
        data = os.read(self._fd, _LINE)
        if not data:
            self._open = False
            return
        *lines, rest = (self._pending + data).split(b"\n")
        self._pending = rest[:_LINE]
        for line in lines:
            word = line.strip()
            count = int(word) if word.isdigit() and len(word) < 8 else 1
            self._left = min(self._left + count, _MOST)
