"""Runs one of our programs to its end."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any, NamedTuple

from tests.server.running import PATIENCE_S


class Result(NamedTuple):
    """How it ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out)
        return found


def run(module: str, *arguments: object, under: tuple[str, ...] = ()) -> Result:
    """Run `python -m module arguments...`, whose error must be no traceback."""
    ended = subprocess.run(
        [*under, sys.executable, "-m", module, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert "Traceback" not in ended.stderr, ended.stderr
    return Result(ended.returncode, ended.stdout, ended.stderr)
