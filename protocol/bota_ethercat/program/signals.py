# SPDX-License-Identifier: Apache-2.0
"""What the signals that ask a program to end do once it is loaded; before, `start` has them end it at once.

Either they are remembered (`Signals`), by programs that have something to finish, or they raise
KeyboardInterrupt (`interrupt_on_signals`), but within `signals_held_back` and `signals_call`.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType


def asking() -> list[signal.Signals]:
    """SIGINT, SIGTERM and, of a terminal or SSH connection that is gone, SIGHUP, which nohup ignores."""
    found = [signal.SIGINT, signal.SIGTERM]
    # Windows lacks it.
    if (hang_up := getattr(signal, "SIGHUP", None)) and signal.getsignal(hang_up) is not signal.SIG_IGN:
        found.append(hang_up)
    return found


class Signals:
    """The signals that ask the program to end.

    Attributes:
        asked: whether one has arrived; set it to stop without one.
    """

    def __init__(self) -> None:
        self.asked = False
        self._stop: Callable[[], object] = lambda: None
        for number in asking():
            signal.signal(number, self._on_signal)
        _unblock()

    def call(self, stop: Callable[[], object]) -> None:
        """From now on a signal calls `stop`, also one that has arrived already."""
        self._stop = stop
        if self.asked:
            stop()

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
        self._stop()


def interrupt_on_signals() -> None:
    """They raise KeyboardInterrupt: for when everything is imported."""
    for number in asking():
        signal.signal(number, signal.default_int_handler)
    _unblock()


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Defer them during a change."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, asking())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def signals_call(handle: Callable[[], None]) -> Iterator[None]:
    """They only call `handle`."""
    before = {number: signal.signal(number, lambda *_: handle()) for number in asking()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _unblock() -> None:
    """The program that started this one may have had them blocked, which is inherited."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, asking())
