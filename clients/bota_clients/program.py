"""What the programs here have in common: messages, signals, and how they end."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Final

from bota_clients.errors import ClientError
from bota_ethercat.errors import ProtocolError
from bota_ethercat.program.signals import Signals, interrupt_on_signals

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

__all__ = [
    "Signals", "call_on", "discard_output", "interrupt_on_signals", "not_installed", "say", "start",
]  # fmt: skip

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
        sys.stdout.flush()
    except BrokenPipeError:
        discard_output()
        code = 1
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


def discard_output() -> None:
    """The reader of standard output has gone: avoid another error when Python flushes it at exit."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def call_on(loop: AbstractEventLoop, stop: Callable[[], object], *names: str) -> None:
    """Have these signals call `stop`; those that nohup ignores do not, nor any on Windows."""
    for name in names:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            with contextlib.suppress(NotImplementedError):
                loop.add_signal_handler(number, stop)
