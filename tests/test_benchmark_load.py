"""The benchmark beside endless loops: which samples met a stall, and its table."""

from __future__ import annotations

import numpy as np
import pytest
from rich.console import Console

from scripts.benchmarks import program as benchmark
from scripts.benchmarks.modes.load import in_stalls, table
from scripts.benchmarks.statistics import Arrivals


def test_samples_on_their_way_during_a_stall() -> None:
    instants = np.array([0, 100, 200, 300, 400], dtype=np.int64)
    arrivals = Arrivals(np.arange(5), instants, instants, instants + 50)
    stalls = np.array([[90, 95], [149, 210], [260, 390]], dtype=np.int64)
    assert in_stalls(arrivals, stalls).tolist() == [False, True, True, True, False]
    assert not in_stalls(arrivals, np.empty((0, 2), dtype=np.int64)).any()


def test_each_chain_has_a_row() -> None:
    ages = {"p50": 1.2, "p99": 2.6, "p999": 3.0}
    figures = {
        "lost": 3, "lost_in_stops": 2,
        "hand_out_us": ages, "age_us": ages, "age_outside_stalls_us": None,
    }  # fmt: skip
    console = Console(width=120, record=True)
    console.print(table({"wrench, real-time": figures}, 800, 4))
    text = console.export_text()
    assert "800 Hz beside 4 endless loops" in text
    for cell in ("wrench, real-time", "3 (2)", "1 / 3 / 3", " -\n"):
        assert cell in text


@pytest.mark.parametrize("wrong", ["0", "65", "x"])
def test_a_senseless_number_of_loops_is_refused(wrong: str) -> None:
    with pytest.raises(SystemExit):
        benchmark.parse(["--load", wrong])
