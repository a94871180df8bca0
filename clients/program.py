"""What the programs here have in common: version, messages, signals, and how they end."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from types import FrameType

try:
    VERSION = version("bota-ethercat-bridge")
except PackageNotFoundError:  # run from a checkout that was never installed
    VERSION = "0+unknown"


def say(program: str, sentence: str) -> None:
    """Print a sentence on standard error."""
    sys.stderr.write(f"{program}: {sentence}\n")
    sys.stderr.flush()


def missing(name: object) -> str:
    """That a package or program is not installed, and how to install it."""
    return f"{name} is not installed: pip install 'bota-ethercat-bridge[tools]'"


def not_installed(program: str, error: ImportError) -> int:
    """Say which package is not installed; returns the exit code."""
    say(program, missing(error.name))
    return 1


def discard_output() -> None:
    """The reader of standard output has gone: avoid another error when Python flushes it at exit."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Signals:
    """SIGINT and SIGTERM, remembered from the first moment until there is something to stop.

    Attributes:
        asked: whether one has arrived.
    """

    def __init__(self) -> None:
        self.asked = False
        self._stop: Callable[[], None] | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def call(self, stop: Callable[[], None]) -> None:
        """From now on a signal calls `stop`; at once if one has arrived already."""
        self._stop = stop
        if self.asked:
            stop()

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
        if self._stop is not None:
            self._stop()
