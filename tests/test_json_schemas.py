"""What the programs print with --json is what docs/schemas/ says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from clients.identify.program import run as identify
from clients.monitor.model.state import State
from clients.monitor.view.json_line import json_line
from clients.report.cli import main as report
from ethercat_server.doctor.cli import main as doctor
from tests.clients.monitor_states import gone, healthy, troubled
from tests.clients.recordings import frame, record
from tests.clients.test_identify import posed
from tests.ended import run_here
from tests.json_schema import SCHEMAS, problems


@pytest.mark.parametrize("state", [healthy, troubled, gone])
def test_the_monitors_lines(state: Callable[[], State]) -> None:
    assert not problems("monitor", json.loads(json_line(state(), 1.0)))


def test_the_doctors_findings() -> None:
    found = run_here(doctor, "no-such-one", "--seconds", 0, "--json").json
    assert not problems("doctor", found)
    assert found["findings"]
    assert not problems("doctor", run_here(doctor, "x/y", "--json").json)


def test_the_result_of_an_identification(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, posed())
    found = run_here(identify, path, "--json")
    assert (found.code, found.json["ok"]) == (0, True)
    assert not problems("identify", found.json)
    refused = run_here(identify, path, "--json", "--least-seconds", 3600)
    assert (refused.code, refused.json["ok"]) == (1, False)
    assert not problems("identify", refused.json)


def test_the_checks_of_a_report(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, [frame(number, size=77) for number in range(400)])
    found = run_here(report, path, "--json").json
    assert found
    assert not problems("report", found)


@pytest.mark.parametrize("path", sorted(SCHEMAS.glob("*.json")), ids=lambda path: path.stem)
def test_a_schema_accepts_nothing_else(path: Path) -> None:
    assert problems(path.stem, {"colour": "red"})
    assert problems(path.stem, [{"colour": "red"}])


def test_every_schema_is_in_the_table() -> None:
    text = (SCHEMAS.parent / "programs.md").read_text()
    assert not [path.name for path in SCHEMAS.glob("*.json") if f"schemas/{path.name}" not in text]
