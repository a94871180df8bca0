"""What the programs here have in common: messages, signals, and how they end."""

from __future__ import annotations

import contextlib
import io
import shlex
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from bota_clients.errors import RecordingError
from bota_ethercat.errors import ProtocolError
from bota_ethercat.program.signals import Signals, interrupt_on_signals

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

__all__ = ["Signals", "call_on", "interrupt_on_signals", "say", "start"]

_OF_DATASETS: Final = ("pyarrow", "zarr", "rosbags", "yaml")


def say(program: str, sentence: str) -> None:
    sys.stderr.write(f"{program}: {sentence}\n")
    sys.stderr.flush()


def start(program: str, module: str, *arguments: object) -> int:
    """The exit code of `run` in a module that is imported only now: `--help` needs nothing of the extra.

    Errors of this project become one sentence and exit code 1. That nobody reads standard error is none.
    """
    if sys.stderr is sys.__stderr__:  # not in a test, nor closed
        sys.stderr = _standard_error()
    try:
        code: int = import_module(f"bota_clients.{module}").run(*arguments)
        return code
    except ImportError as error:
        package = (error.name or str(error)).partition(".")[0]
        extra = "dataset" if package in _OF_DATASETS else "client"
        command = shlex.join([sys.executable, "-m", "pip", "install", f".[{extra}]"])
        said = f"{package} is not installed: in this project's folder run {command}"
    except (RecordingError, ProtocolError) as error:
        said = str(error)
    except KeyboardInterrupt:  # of those that write a file at the end
        said = "stopped: nothing was written"
    say(program, said)
    return 1


class _Unheard(io.FileIO):
    """Standard error whose reader, terminal or disk may go: what it said is not worth the program's end."""

    def write(self, data: Any, /) -> int:
        """How much of it is done with: all, unless a part was written."""
        written: int | None = None
        with contextlib.suppress(OSError):
            written = super().write(data)
        return memoryview(data).nbytes if written is None else written


def _standard_error() -> io.TextIOWrapper:
    file = io.BufferedWriter(_Unheard(2, "w", closefd=False))
    return io.TextIOWrapper(file, sys.stderr.encoding, "backslashreplace", line_buffering=True)


def call_on(loop: AbstractEventLoop, stop: Callable[[], object], *names: str) -> None:
    """Have these signals call `stop`; those that nohup ignores do not, nor any on Windows."""
    for name in names:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            with contextlib.suppress(NotImplementedError):
                loop.add_signal_handler(number, stop)
