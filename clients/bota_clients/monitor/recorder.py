"""Runs `ethercat-record` as a child process: starts it, stops it, reports the result."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Final

from bota_clients.program import missing
from bota_ethercat.address import Address
from bota_ethercat.text.untrusted import printable

PROGRAM: Final = "ethercat-record"
_STOP_TIMEOUT_S: Final = 20.0


class Recorder:
    """At most one recording at a time."""

    def __init__(self, address: Address, command: Sequence[str] | None = None) -> None:
        """`command`: another program than `ethercat-record`, with its first arguments."""
        self._address = address
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes]  # what it prints
        self.since_s = 0.0

    @property
    def running(self) -> bool:
        """Whether a recording was started and has not been reported as ended."""
        return self._process is not None

    def start(self, now_s: float) -> tuple[str, bool]:
        """Start a recording; a message, and whether it is an error."""
        program = shutil.which(PROGRAM, path=Path(sys.executable).parent) or shutil.which(PROGRAM)
        command = self._command or (program and [program])
        if not command:
            return missing(PROGRAM), True
        name = time.strftime("recording-%Y%m%d-%H%M%S.mcap")
        said = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        try:
            # A session of its own: Ctrl-C is for the monitor, which then stops it.
            self._process = subprocess.Popen(
                [*command, name, "--server", str(self._address), "--until-eof"],
                stdin=subprocess.PIPE,  # closed when the monitor ends, however it ends
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        except OSError as error:
            said.close()
            return f"{PROGRAM} cannot be started: {error.strerror or error}", True
        self._said, self.since_s = said, now_s
        return f"Recording to {name}", False

    def stop(self) -> None:
        """Request the end; `ended` reports it."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()  # which it takes as the request to stop

    def ended(self) -> tuple[str, bool] | None:
        """A message about a recording that has ended, and whether it is an error; else None."""
        if self._process is None or self._process.poll() is None:
            return None
        code, said = self._process.returncode, self._said
        self.stop()
        self._process = None
        said.seek(0)
        lines = said.read()[-4096:].decode(errors="replace").strip().splitlines() or [""]
        said.close()
        last = printable(lines[-1]).removeprefix(f"{PROGRAM}: ")
        if code == 0:
            return f"Recorded {last}" if last else "The recording has ended", False
        return f"The recording failed: {last or f'exit code {code}'}", True

    def close(self) -> str | None:
        """Stop the recording and wait for it; a message, if there was one."""
        if self._process is None:
            return None
        self.stop()
        try:
            self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        found = self.ended()
        return found[0] if found else None
