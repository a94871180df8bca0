"""The benchmark beside Bota's driver: what it makes of recordings, and where the driver cannot be had."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scripts.benchmarks import comparison
from scripts.benchmarks import program as benchmark
from scripts.benchmarks.modes import vendor
from scripts.benchmarks.modes.vendor import first_ages
from scripts.benchmarks.statistics import Arrivals
from scripts.demonstration.child import DemoError

PERIOD_NS = 1_250_000


def test_a_repeated_sample_is_as_old_as_when_it_was_returned_first() -> None:
    number = np.array([1, 1, 2, 4, 4, 4])
    instant = number * PERIOD_NS
    ages = np.array([300, 1550, 400, 500, 1750, 3000])
    arrivals = Arrivals(number, instant, np.zeros_like(number), instant + ages)
    assert first_ages(arrivals).tolist() == [300, 400, 500]


@pytest.mark.parametrize("there", [True, False])
def test_it_is_measured_if_it_is_there(there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEMO_DIRECTORY", str(tmp_path))
    monkeypatch.setattr(comparison, "build", lambda _: tmp_path)
    monkeypatch.setattr(vendor, "installed", lambda: there)
    found = comparison.Compared.find(benchmark.parse(["--vendor"]))
    assert (found.driver, set(found.missing)) == (there, set() if there else {"driver"})
    assert found.yardstick == tmp_path
    assert not comparison.Compared.find(benchmark.parse([])).driver


def test_without_it_the_rest_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise DemoError("bota-driver cannot be installed")

    monkeypatch.setattr(vendor, "installed", lambda: False)
    monkeypatch.setattr(vendor, "install", fail)
    assert vendor.main() == 0
    assert capsys.readouterr().err == "benchmark: bota-driver cannot be installed\n"
