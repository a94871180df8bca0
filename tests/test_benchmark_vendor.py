"""The benchmark beside Bota's driver: what it makes of recordings, its table, and its command line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rich.console import Console

from scripts.benchmarks import program as benchmark
from scripts.benchmarks import statistics
from scripts.benchmarks.chain import Setup
from scripts.benchmarks.modes import vendor
from scripts.benchmarks.modes.vendor import first_ages, measure_vendor, rows, table
from scripts.benchmarks.statistics import Arrivals
from scripts.demonstration.child import DemoError

PERIOD_NS = 1_250_000
NO_STOPS = np.empty((0, 2), dtype=np.int64)
SETUP = Setup(800, 1, 1.0, 0.0, 0, ppm=0.0)


def recorded(numbers: list[int], ages_ns: list[int]) -> Arrivals:
    number = np.array(numbers)
    instant = number * PERIOD_NS
    return Arrivals(number, instant, np.zeros_like(number), instant + np.array(ages_ns))


def figures(arrivals: Arrivals, process: str) -> dict[str, Any]:
    found, _ = statistics.summary([arrivals], PERIOD_NS, NO_STOPS)
    first = statistics.spread_us(first_ages(arrivals))
    return {
        **found,
        "first_age_us": first,
        "cpu_percent": {process: 5.5, "sensor": 7.0, "everything else": 1.0},
    }


def test_a_repeated_sample_is_as_old_as_when_it_was_returned_first() -> None:
    arrivals = recorded([1, 1, 2, 4, 4, 4], [300, 1550, 400, 500, 1750, 3000])
    assert first_ages(arrivals).tolist() == [300, 400, 500]


def test_a_column_has_what_was_lost_repeated_and_new() -> None:
    arrivals = recorded([1, 1, 2, 4], [200_000, 1_400_000, 200_000, 200_000])
    cells = rows(figures(arrivals, "driver"), 0.005)
    assert cells["samples made"] == "4"
    assert cells["lost (in stalls)"] == "1 (0)"
    assert cells["repeated"] == "1"
    assert cells["new samples, 1/s"] == "600.0"
    assert cells["age, first return, µs"] == "200 / 200"
    assert cells["age, every return, µs"] == "200 / 1364"
    assert cells["CPU, %"] == "5.5"


def test_a_way_that_was_not_measured_has_no_column() -> None:
    arrivals = recorded([1, 2, 3], [100_000, 100_000, 100_000])
    result = {"rate_hz": 800, "version": "1.2.3", "this": figures(arrivals, "server")}
    console = Console(width=120, record=True, quiet=True)
    assert len(table(result, 1.0).columns) == 2
    result["driver"] = figures(arrivals, "driver")
    assert len(table(result, 1.0).columns) == 3
    console.print(table(result, 1.0))


def test_it_is_measured_on_one_sensor_only() -> None:
    options = benchmark.parse(["--vendor"])
    assert (options.vendor, options.rates, options.sensors) == (True, [800], [1])
    with pytest.raises(DemoError, match="one sensor"):
        measure_vendor(Setup(800, 2, 1.0, 0.0, 0, ppm=0.0), Console(quiet=True))


def test_without_the_package_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vendor, "installed", lambda: False)
    with pytest.raises(DemoError, match="scripts/benchmark --vendor"):
        measure_vendor(SETUP, Console(quiet=True))


def test_a_failed_installation_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise DemoError("bota-driver cannot be installed")

    monkeypatch.setattr(vendor, "installed", lambda: False)
    monkeypatch.setattr(vendor, "install", fail)
    assert vendor.main() == 1
    assert capsys.readouterr().err == "benchmark: bota-driver cannot be installed\n"
