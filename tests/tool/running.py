"""Runs `ethercat-sensor`, in this process or as one of its own."""

from __future__ import annotations

from typing import Any

from ethercat_server.tool.cli import main
from tests.ended import Result, patiently, run, run_here

MODULE = "ethercat_server.tool.cli"


def tool(*arguments: object, code: int | None = 0) -> Result:
    """Run `ethercat-sensor arguments...` as a process; it must end with `code` (None: any)."""
    result = patiently(lambda: run(MODULE, *arguments))
    assert code is None or result.code == code, result
    return result


def tool_here(*arguments: object, code: int | None = 0) -> Result:
    """Run `ethercat-sensor arguments...` in this process, where no interface is opened."""
    result = run_here(main, *arguments)
    assert code is None or result.code == code, result
    return result


def one_sentence(result: Result) -> str:
    """The error of a failed run: one line, but for what a machine without real-time scheduling adds."""
    lines = [line for line in result.err.splitlines() if "not granted" not in line]
    assert len(lines) == 1, result
    assert lines[0].startswith("ethercat-sensor: ")
    return lines[0]


def refused(*arguments: object, code: int = 1) -> str:
    """The error of a command that must fail, in this process."""
    return one_sentence(tool_here(*arguments, code=code))


def told(*arguments: object, code: int | None = 0) -> dict[str, Any]:
    """The JSON object of a command in this process."""
    return tool_here(*arguments, "--json", code=code).json


def offset(*where: object) -> list[float]:
    """The force/torque offset of a sensor."""
    rows = told("read", *where, "Force/Torque Offset")["sensors"][0]["objects"]
    return [row["value"] for row in rows[1:]]
