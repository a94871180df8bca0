"""SIGINT and SIGTERM as an ordinary call from an ordinary thread.

Both signals are blocked in every thread and one thread waits for them. A handler would run only when the
main thread next executes Python, which it does not while it waits inside ROS for the next message.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from typing import Final

STOP_SIGNALS: Final = frozenset({signal.SIGINT, signal.SIGTERM})
_SAME_S: Final = 1.0


def block_stop_signals() -> None:
    """Keep SIGINT and SIGTERM pending in this thread and all it starts later."""
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)


def call_on_stop_signal(callback: Callable[[signal.Signals], None]) -> None:
    """Call `callback` from a thread of its own at the first signal.

    A later one ends the process at once, but not one right behind the first: a terminal and a launcher may
    each send theirs.
    """

    def wait() -> None:
        callback(signal.Signals(signal.sigwait(STOP_SIGNALS)))
        impatient_s = time.monotonic() + _SAME_S
        while True:
            number = signal.sigwait(STOP_SIGNALS)
            if time.monotonic() >= impatient_s:
                os._exit(128 + number)

    threading.Thread(target=wait, name="signals", daemon=True).start()
