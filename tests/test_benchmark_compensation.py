"""The benchmark of the compensation: every case is compensated, and what costs too much ends it."""

from __future__ import annotations

import io

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from rich.console import Console

from scripts.benchmarks import program as benchmark
from scripts.benchmarks.chain import Setup
from scripts.benchmarks.modes import compensation
from scripts.demonstration.child import DemoError

pytestmark = pytest.mark.ros
SETUP = Setup(800, 1, 1.0, 0.0, 0, ppm=0.0)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compensation, "SAMPLES", 200)
    monkeypatch.setattr(compensation, "MOST_US", 1e9)
    monkeypatch.setattr(compensation, "MOST_BY_DEFAULT_US", 1e9)


def test_every_case_costs_something() -> None:
    shown = io.StringIO()
    found = compensation.measure_compensation(SETUP, Console(file=shown, width=100))
    assert next(iter(found)) == "decoding"
    assert len(found) == 7
    for name, cost in found.items():
        assert 0.0 < cost["50"] <= cost["99"]
        assert name in shown.getvalue()


@pytest.mark.parametrize("limit", ["MOST_US", "MOST_BY_DEFAULT_US"])
def test_too_much_is_said(monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    monkeypatch.setattr(compensation, limit, 1e-6)
    with pytest.raises(DemoError, match=r"takes \d+\.\d µs a sample, more than"):
        compensation.measure_compensation(SETUP, Console(file=io.StringIO()))


def test_its_option() -> None:
    assert benchmark.parse(["--compensation"]).compensation
