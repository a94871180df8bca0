"""What the programs here have in common: messages, signals, and how they end."""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Final

from bota_clients.errors import ClientError
from bota_ethercat.errors import ProtocolError

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop


_OF_DATASETS: Final = ("pyarrow", "zarr", "rosbags", "yaml")


def say(program: str, sentence: str) -> None:
    """Print a sentence on standard error."""
    sys.stderr.write(f"{program}: {sentence}\n")
    sys.stderr.flush()


def start(program: str, module: str, *arguments: object) -> int:
    """The exit code of `run` in a module that is imported only now: `--help` needs nothing of the extra.

    Errors of this project become one sentence and exit code 1.
    """
    try:
        code: int = import_module(f"bota_clients.{module}").run(*arguments)
    except ImportError as error:
        code = not_installed(program, error)
    except (ClientError, ProtocolError) as error:
        say(program, str(error))
        code = 1
    return code


def not_installed(program: str, error: ImportError) -> int:
    """Say which package is not installed, and how to install it; returns the exit code."""
    package = (error.name or str(error)).partition(".")[0]
    extra = "dataset" if package in _OF_DATASETS else "client"
    command = shlex.join([sys.executable, "-m", "pip", "install", f".[{extra}]"])
    say(program, f"{package} is not installed: in this project's folder run {command}")
    return 1


def interrupt_on_signals() -> None:
    """SIGINT and SIGTERM raise KeyboardInterrupt: for when everything is imported, see `start`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def call_on(loop: AbstractEventLoop, stop: Callable[[], object], *names: str) -> None:
    """Have these signals call `stop`; those that nohup ignores do not, nor any on Windows."""
    for name in names:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            with contextlib.suppress(NotImplementedError):
                loop.add_signal_handler(number, stop)


class Signals:
    """SIGINT and SIGTERM, remembered from the first moment until there is something to stop.

    Attributes:
        asked: whether one has arrived; set it to stop without one.
    """

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
