"""SIGINT and SIGTERM stop the server, and so does SIGHUP, unless it is started with nohup."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator

from bota_ethercat.program import signals
from ethercat_server.errors import StopRequestedError


class Signals(signals.Signals):
    """Checked between the steps of start-up; passed on to the loop once it runs."""

    def check(self) -> None:
        if self.asked:
            raise StopRequestedError("stopped during start-up")


@contextlib.contextmanager
def signals_held_back() -> Iterator[None]:
    """Defer SIGINT and SIGTERM during a change."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
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
