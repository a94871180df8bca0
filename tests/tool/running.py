"""Runs `ethercat-sensor` as a process, and gives the virtual sensor commands."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any, NamedTuple

from tests.server.running import PATIENCE_S, Program


class Result(NamedTuple):
    """How a subcommand ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out)
        return found


def tool(*arguments: object, code: int | None = 0) -> Result:
    """Run `ethercat-sensor arguments...`; it must end with `code` (None: any)."""
    ended = subprocess.run(
        [sys.executable, "-m", "ethercat_server.tool.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    result = Result(ended.returncode, ended.stdout, ended.stderr)
    assert "Traceback" not in result.err, result.err
    assert code is None or result.code == code, result
    return result


def command(sensor: Program, text: str) -> str:
    """Give the virtual sensor a command; returns its answer."""
    assert sensor.process.stdin is not None
    before = len(sensor.said())
    sensor.process.stdin.write(text + "\n")
    sensor.process.stdin.flush()
    deadline = time.monotonic() + 10
    while not sensor.said()[before:].endswith("\n"):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    answer = sensor.said()[before:].strip()
    assert answer.startswith("ok"), answer
    return answer


def stats(sensor: Program, place: int = 0) -> dict[str, Any]:
    """What the virtual sensor says of itself."""
    answer = command(sensor, "stats")
    found: dict[str, Any] = json.loads(answer[answer.index("{") :])["sensors"][place]
    return found


def written(sensor: Program, place: int = 0) -> list[tuple[str, int, str]]:
    """The SDO writes so far: index, sub-index, data."""
    return [(row["index"], row["subindex"], row["hex"]) for row in stats(sensor, place)["sdo_writes"]]


def complaints(err: str) -> list[str]:
    """What was said on standard error, but for what a machine without real-time scheduling adds."""
    return [line for line in err.splitlines() if "not granted" not in line]


def one_sentence(result: Result) -> str:
    """The error of a failed run, which is one line on standard error."""
    lines = complaints(result.err)
    assert len(lines) == 1, result
    assert lines[0].startswith("ethercat-sensor: ")
    return lines[0]
