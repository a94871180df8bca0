"""A program that the demo or the benchmark runs beside itself."""

from __future__ import annotations

import ctypes
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

_STOP_TIMEOUT_S: Final = 8.0
_PR_SET_PDEATHSIG: Final = 1


class DemoError(Exception):
    """The demo cannot go on; the text is one sentence."""


class Child:
    """A program of ours that runs beside the demo and never outlives it."""

    def __init__(self, name: str, command: Sequence[str], directory: Path) -> None:
        self.name = name
        self._log = directory / f"{name}.log"
        libc = ctypes.CDLL(None)

        def die_with_parent() -> None:
            libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
            signal.pthread_sigmask(signal.SIG_SETMASK, set())
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)

        with self._log.open("wb") as log:
            # A session of its own: Ctrl-C is for the demo, which then stops its children in order.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=die_with_parent,  # noqa: PLW1509 - there are no threads yet
            )

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    def check(self) -> None:
        """DemoError, with its last words, if it has ended."""
        code = self._process.poll()
        if code is not None:
            lines = self._log.read_text(errors="replace").strip().splitlines()[-8:]
            raise DemoError(
                "\n    ".join([f"{self.name} ended by itself with exit code {code}; it said:", *lines])
            )

    def stop(self) -> str | None:
        """End it; what was wrong about how it ended, or None."""
        early = self._process.poll()
        if early is None:
            self._process.terminate()
        try:
            code = self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return f"{self.name} did not end when told to and was killed"
        return None if code == 0 else f"{self.name} ended with exit code {code}"
