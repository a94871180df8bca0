"""Commands for a virtual sensor that runs as a process, given on its standard input."""

from __future__ import annotations

import json
import time
from typing import Any

from tests.server.running import PATIENCE_S, Program


def command(sensor: Program, text: str) -> str:
    """Give the virtual sensor a command; returns its answer."""
    assert sensor.process.stdin is not None
    before = len(sensor.said())
    sensor.process.stdin.write(text + "\n")
    sensor.process.stdin.flush()
    deadline = time.monotonic() + PATIENCE_S
    while not sensor.said()[before:].endswith("\n"):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    answer = sensor.said()[before:].strip()
    assert answer.startswith("ok"), answer
    return answer


def stats(sensor: Program, position: int = 0) -> dict[str, Any]:
    """What the virtual sensor says of itself."""
    answer = command(sensor, "stats")
    found: dict[str, Any] = json.loads(answer[answer.index("{") :])["sensors"][position]
    return found


def written(sensor: Program, position: int = 0) -> list[tuple[str, int, str]]:
    """The SDO writes so far: index, sub-index, data."""
    return [(row["index"], row["subindex"], row["hex"]) for row in stats(sensor, position)["sdo_writes"]]
