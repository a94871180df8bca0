"""The sensor's flash: what survives a power cut, and how saving into it goes.

Entries are written one after another, in order of address. A power cut in between leaves those before it new
and the rest as they were.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

Address = tuple[int, int]
"""Index and sub-index of an object entry."""

BUSY: Final = 0xFF
"""Status while a save is under way."""


class Flash:
    """Entries by address. Times are CLOCK_MONOTONIC, ns."""

    def __init__(self) -> None:
        self.entries: dict[Address, bytes] = {}
        self.seconds = 0.0
        """How long a save takes."""
        self.result = 0
        """Status with which a save ends; 0 is success, with any other nothing is kept."""
        self.cut: tuple[int, Callable[[], None]] | None = None
        """In the next save the power goes after so many entries, by this."""
        self._waiting: deque[tuple[float, Address, bytes]] = deque()
        self._ends = 0.0

    def save(self, values: Mapping[Address, bytes], now: int) -> None:
        """Begin to write `values`."""
        if self.cut is not None:
            (count, cut_power), self.cut = self.cut, None
            self.entries.update(sorted(values.items())[:count])
            cut_power()
            return
        length = self.seconds * 1e9
        self._ends = now + length
        step = length / max(len(values), 1)
        rows = sorted(values.items()) if not self.result else []
        self._waiting = deque((now + (n + 1) * step, *row) for n, row in enumerate(rows))
        self.advance(now)

    def advance(self, now: int) -> None:
        """Write what is due."""
        while self._waiting and self._waiting[0][0] <= now:
            _, address, data = self._waiting.popleft()
            self.entries[address] = data

    def status(self, now: int) -> int:
        """What object 0x8030:2 says of the last save."""
        self.advance(now)
        return BUSY if now < self._ends else self.result

    def power_cut(self, now: int) -> None:
        """What is not written by now never will be."""
        self.advance(now)
        self._waiting.clear()
        self._ends = 0.0
