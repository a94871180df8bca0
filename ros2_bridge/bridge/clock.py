"""Time as the node's threads see it, so that a test can let it pass as it likes."""

from __future__ import annotations

import threading
import time
from typing import Final, Protocol


class Clock(Protocol):
    """CLOCK_MONOTONIC for what is measured, CLOCK_REALTIME for stamps, and waiting."""

    def monotonic(self) -> float:
        """CLOCK_MONOTONIC, s."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""

    def time_ns(self) -> int:
        """CLOCK_REALTIME, ns."""

    def wait(self, event: threading.Event, seconds: float, /) -> bool:
        """Wait until `event` is set, so many seconds at most; whether it is."""


class SystemClock:
    """The kernel's clocks."""

    monotonic = staticmethod(time.monotonic)
    monotonic_ns = staticmethod(time.monotonic_ns)
    time_ns = staticmethod(time.time_ns)
    wait = staticmethod(threading.Event.wait)


SYSTEM_CLOCK: Final = SystemClock()
