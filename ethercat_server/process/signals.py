"""SIGINT and SIGTERM stop the server, and so does SIGHUP, unless it is started with nohup."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType

from ethercat_server.errors import StopRequestedError


class Signals:
    """Checked between the steps of start-up; passed on to the loop once it runs."""

    def __init__(self) -> None:
        self._stop: Callable[[], None] | None = None
        self._received = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_stop)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            signal.signal(signal.SIGHUP, self._on_stop)

    def check(self) -> None:
        """StopRequestedError if a signal has arrived."""
        if self._received:
            raise StopRequestedError("stopped during start-up")

    def call(self, stop: Callable[[], None]) -> None:
        """From now on a signal calls `stop`."""
        self._stop = stop
        if self._received:
            stop()

    def _on_stop(self, _number: int, _frame: FrameType | None) -> None:
        self._received = True
        if self._stop is not None:
            self._stop()


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Defer SIGINT and SIGTERM during a change."""
    signals = {signal.SIGINT, signal.SIGTERM}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def signals_call(handle: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM only call `handle`."""
    before = {
        number: signal.signal(number, lambda *_: handle()) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
