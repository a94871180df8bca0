"""The sensor's flash, and the process of saving to it.

Entries are written one by one in order of address; a power loss in between leaves the rest unchanged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

from ethercat_server.virtual_sensor.slave.objects import Address

BUSY: Final = 0xFF
"""Status while a save is under way."""


class Flash:
    """Entries by address. Times are in ns."""

    def __init__(self) -> None:
        self.entries: dict[Address, bytes] = {}
        self.seconds = 0.0
        """Duration of a save."""
        self.result = 0
        """Status at the end of a save; 0 is success, with any other nothing is stored."""
        self.cut: tuple[int, Callable[[], None]] | None = None
        """Number of entries after which the next save loses power, and the action for it."""
        self._waiting: deque[tuple[float, Address, bytes]] = deque()
        self._ends = 0.0

    def save(self, values: Mapping[Address, bytes], now: int) -> None:
        """Start to write `values`."""
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
        """Value of object 0x8030:2 for the last save."""
        self.advance(now)
        return BUSY if now < self._ends else self.result

    def power_cut(self, now: int) -> None:
        """Drop what is not written yet."""
        self.advance(now)
        self._waiting.clear()
        self._ends = 0.0
