"""Runs `ethercat-doctor` as a process."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any, NamedTuple

from tests.server.running import PATIENCE_S

MODULE = "ethercat_server.doctor.cli"


class Result(NamedTuple):
    """How it ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out)
        return found

    def findings(self, subject: str) -> dict[str, dict[str, Any]]:
        """The findings of a subject by check; the last one where there are two."""
        return {row["check"]: row for row in self.json["findings"] if row["subject"] == subject}


def doctor(*arguments: object, module: str = MODULE, under: tuple[str, ...] = ()) -> Result:
    """Run `ethercat-doctor arguments...`."""
    ended = subprocess.run(
        [*under, sys.executable, "-m", module, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert "Traceback" not in ended.stderr, ended.stderr
    assert "fault of the doctor" not in ended.stdout, ended.stdout
    return Result(ended.returncode, ended.stdout, ended.stderr)


def levels(rows: dict[str, dict[str, Any]]) -> dict[str, str]:
    """The level of each check."""
    return {check: row["level"] for check, row in rows.items()}
