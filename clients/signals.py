"""SIGINT and SIGTERM, remembered from the first moment until there is something to stop."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType


class Signals:
    """Notes that one has come, and calls what it was told to call.

    Attributes:
        asked: whether one has come.
    """

    def __init__(self) -> None:
        self.asked = False
        self._stop: Callable[[], None] | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def call(self, stop: Callable[[], None]) -> None:
        """From now on a signal calls `stop`; at once if one has come already."""
        self._stop = stop
        if self.asked:
            stop()

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self._stop is not None:
            self._stop()
