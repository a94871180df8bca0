"""What the programs print with --json is what docs/schemas/ says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from bota_clients.monitor.model import State
from bota_clients.monitor.words import json_line
from bota_clients.report.cli import main as report
from ethercat_server.doctor.cli import main as doctor
from ethercat_server.tool.cli import COMMANDS
from tests.clients.monitor_states import gone, healthy, troubled
from tests.clients.recordings import frame, record
from tests.ended import run_here
from tests.json_schema import SCHEMAS, problems
from tests.simulation import more_if_long, simulated_bus
from tests.tool.running import tool_here


@pytest.mark.parametrize("state", [healthy, troubled, gone])
def test_the_monitors_lines(state: Callable[[], State]) -> None:
    assert not problems("monitor", json.loads(json_line(state(), 1.0)))


def test_the_doctors_findings() -> None:
    found = run_here(doctor, "no-such-one", "--seconds", 0, "--json").json
    assert not problems("doctor", found)
    assert found["findings"]
    assert not problems("doctor", run_here(doctor, "x/y", "--json").json)


def test_the_checks_of_a_report(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, [frame(number, size=77) for number in range(400)])
    found = run_here(report, path, "--json").json
    assert found
    assert not problems("report", found)


@pytest.mark.parametrize("size", more_if_long([77], [61, 77]))
def test_every_command_of_the_tool(size: int, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    asked = [
        ("eeprom",), ("objects",), ("read", "sinc_length", "0x1018:4"), ("snapshot", file), ("save",),
        ("apply", "--dry-run", "--set", "chop=on"), ("apply", "--set", "sinc_length=128"),
        ("restore", file, "--save"), ("restore", file),
    ]  # fmt: skip
    with simulated_bus("--pdo", str(size), "--sinc", 512) as bus:
        for command, *arguments in asked:
            ended = tool_here(command, bus.near, *arguments, "--json", code=None)
            assert not problems("sensor", ended.json, str(command))
        assert problems("sensor", tool_here("read", bus.near, "0x8000", "--json").json, "apply")
    with simulated_bus("--pdo", str(size), "--sinc", 512, "--signal", "rest") as bus:
        assert not problems("sensor", tool_here("tare", bus.near, "--json").json, "tare")
    assert not problems("sensor", tool_here("adapters", "--json").json, "adapters")
    refused = tool_here("objects", "--server", "localhost:0", "--json", code=2)
    assert not problems("sensor", refused.json, "error")


def test_every_command_has_a_schema_and_every_schema_is_in_the_table() -> None:
    parts = json.loads((SCHEMAS / "sensor.json").read_text())["$defs"]
    assert not COMMANDS.keys() - parts.keys()
    text = (SCHEMAS.parent / "programs.md").read_text()
    assert not [path.name for path in SCHEMAS.glob("*.json") if f"schemas/{path.name}" not in text]


@pytest.mark.parametrize("path", sorted(SCHEMAS.glob("*.json")), ids=lambda path: path.stem)
def test_a_schema_accepts_nothing_else(path: Path) -> None:
    assert problems(path.stem, {"colour": "red"})
    assert problems(path.stem, [{"colour": "red"}])
