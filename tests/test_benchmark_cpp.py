"""The benchmark of the C++ client: what it makes of made-up ages, and a short run of its program."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("numpy")

from scripts.benchmarks import program as benchmark
from scripts.benchmarks.modes.cpp import build, figures, run
from scripts.demonstration.program import DemoError
from tests.clients.cpp_programs import needs_gxx, patient


def lines(way: str, who: str, *ages_us: float) -> list[str]:
    return [f"{way} {who} {int(age * 1000)}" for age in ages_us]


def test_the_ratio_is_of_medians_and_of_99th_percentiles() -> None:
    made_up = [
        *lines("waiting", "bare", 20, 20, 30),
        *lines("waiting", "client", 25, 25, 15),
        *lines("polling", "bare", 10),
        *lines("polling", "client", 11),
    ]
    result = figures(made_up)
    assert result["waiting"]["ratio"]["p50"] == 1.25
    assert result["polling"]["ratio"] == {"p50": 1.1, "p99": 1.1}
    assert result["waiting"]["samples"] == 3
    with pytest.raises(DemoError, match="too few samples while polling"):
        figures(made_up[:7])


def test_the_client_is_measured_on_one_configuration() -> None:
    options = benchmark.parse(["--cpp"])
    assert (options.rates, options.sensors) == ([800], [1])


@needs_gxx
@patient
def test_a_short_run_of_the_pair(tmp_path: Path) -> None:
    result = run([str(build(tmp_path)), "pair", "1600", "0.3"], 0.3)
    for way in ("waiting", "polling"):
        assert result[way]["samples"] > 20
        assert result[way]["bare_us"]["min"] > 0
        assert result[way]["client_us"]["min"] > 0
    with pytest.raises(DemoError, match="usage"):
        run([str(tmp_path / "benchmark_cpp"), "nonsense"], 1)
