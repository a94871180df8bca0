"""Runs a command, or one of our programs, to its end."""

from __future__ import annotations

import contextlib
import io
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tests.server.running import ATTEMPTS, PATIENCE_S, STARVED, starved


class Result(NamedTuple):
    """How it ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        assert self.out.isascii(), "valid JSON in whatever encoding it is written"
        found: dict[str, Any] = json.loads(self.out)
        return found


def run_here(main: Callable[[Sequence[str]], int | None], *arguments: object) -> Result:
    """Run a program's `main` in this process."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([*map(str, arguments)]) or 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Result(code, out.getvalue(), err.getvalue())


def completed(*command: object, check: bool = False, **how: Any) -> subprocess.CompletedProcess[str]:
    """A command that has ended; `how` is for `subprocess.run`."""
    return subprocess.run([*map(str, command)], capture_output=True, text=True, check=check, **how)


def run(
    module: str, *arguments: object, under: tuple[str, ...] = (), python: str | Path = sys.executable
) -> Result:
    """Run `python -m module arguments...`, whose error must be no traceback."""
    ended = completed(*under, python, "-m", module, *arguments, timeout=PATIENCE_S)
    assert "Traceback" not in ended.stderr, ended.stderr
    return Result(ended.returncode, ended.stdout, ended.stderr)


def patiently(ends: Callable[[], Result], words: Sequence[str] = STARVED) -> Result:
    """How it ended, at last where a busy machine had the virtual sensor's process wait for too long."""
    for _ in range(ATTEMPTS):
        ended = ends()
        if not starved(ended.out + ended.err, words):
            break
    return ended
