"""Programs that run beside each other for the demo and the benchmark, and end together."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Final

from bota_ethercat.address import DEFAULT_PORT
from bota_ethercat.client import Client
from bota_ethercat.errors import ProtocolError
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.nic import change_flags

_START_TIMEOUT_S: Final = 30.0
_STOP_TIMEOUT_S: Final = 8.0


class ScriptError(Exception):
    """The benchmark or the demo cannot go on; the text is one sentence."""


class Stopped(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


class Child:
    """A program that never outlives this process; it may end by itself once `result` exists."""

    def __init__(self, name: str, command: list[str], directory: Path) -> None:
        self.name, self.result = name, directory / name
        self.log = directory / f"{name}.log"
        with self.log.open("wb") as log:
            # A session of its own: Ctrl-C reaches this process only, which then ends its children in order.
            self._process = subprocess.Popen(
                ["setpriv", "--pdeathsig", "SIGTERM", *command],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        self.pid = self._process.pid

    def check(self) -> None:
        """ScriptError, with its last lines of output, if it has failed."""
        code = self._process.poll()
        if code is not None and not self.result.exists():
            lines = self.log.read_text(errors="replace").strip().splitlines()[-8:]
            text = f"{self.name} ended by itself with exit code {code}; its last output:"
            raise ScriptError("\n    ".join([text, *lines]))

    def stop(self) -> str | None:
        """End it; what was wrong about how it ended, or None."""
        self._process.terminate()
        try:
            code = self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return f"{self.name} did not end at SIGTERM and was killed"
        return None if code == 0 else f"{self.name} ended with exit code {code}"


class Chain(contextlib.ExitStack):
    """A context in which programs run, and with which all of them end."""

    def __init__(self) -> None:
        super().__init__()
        self.children: list[Child] = []
        self.link: Client | None = None
        self.directory = Path(tempfile.mkdtemp(dir=os.environ.get("DEMO_DIRECTORY")))
        self.callback(shutil.rmtree, self.directory, ignore_errors=True)
        self.callback(self.stop)

    def start(self, name: str, *command: object) -> Child:
        """Start any program; of the one named `server` `measure` has the CPU time."""
        child = Child(name, list(map(str, command)), self.directory)
        self.children.append(child)
        return child

    def python(self, name: str, module: str, *arguments: object) -> Child:
        return self.start(name, sys.executable, "-m", module, *arguments)

    def connect(self, sensors: int) -> Client:
        """Connect as soon as the server describes this number of sensors; closed with the chain."""

        def ready() -> bool:
            with contextlib.suppress(ProtocolError):
                self.link = Client(DEFAULT_PORT, stream=False, raw=True, reconnect=False).connect()
                self.callback(self.link.close)
                return len(self.link.description["sensors"]) == sensors
            return False

        self.wait(ready, "the server was not ready")
        assert self.link is not None
        return self.link

    def check(self) -> None:
        """ScriptError if a program has failed."""
        for child in self.children:
            child.check()

    def wait(self, done: Callable[[], bool], what: str = "a program did not get ready",
             seconds: float = _START_TIMEOUT_S) -> None:  # fmt: skip
        """Wait; ScriptError if a program fails or it takes too long."""
        deadline = time.monotonic() + seconds
        while not done():
            self.check()
            if time.monotonic() > deadline:
                raise ScriptError(f"{what} within {seconds:g} s")
            time.sleep(0.02)

    def sleep(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end, seconds=math.inf)  # it may have been stopped meanwhile

    def stop(self) -> list[str]:
        """End everything, the last first; what was wrong about how they ended."""
        troubles = [child.stop() for child in reversed(self.children)]
        self.children.clear()
        return [trouble for trouble in troubles if trouble]


def loopback_up() -> None:
    """Set the new namespace's loopback interface up, as `ip link set lo up` does."""
    change_flags(socket.if_nametoindex("lo"), on=1)  # IFF_UP


def stoppable(run: Callable[[], int], program: str, sentence: str, code: int) -> int:
    """Run a program, whose directory is removed however it ends; its exit code.

    If it is stopped, the sentence is said and the code returned.
    """
    from bota_ethercat.program.start import open_streams  # noqa: PLC0415 - it sets the action of SIGINT

    open_streams()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _on_signal)
    if "DEMO_DIRECTORY" not in os.environ:
        os.environ["DEMO_DIRECTORY"] = tempfile.mkdtemp()
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        return run()
    except Stopped:
        print(sentence, file=sys.stderr if code else sys.stdout)
        return code
    except BrokenPipeError:  # nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ScriptError, ServerError, OSError) as error:
        print(f"{program}: {error}", file=sys.stderr)
    finally:
        ignore_signals()
        shutil.rmtree(os.environ.pop("DEMO_DIRECTORY"), ignore_errors=True)
    return 1


def _on_signal(_number: int, _frame: FrameType | None) -> None:
    ignore_signals()  # the clean-up is not to be interrupted
    raise Stopped


def ignore_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
