"""The benchmark of slow network cards: the relay's delay, what is measured, table, command line."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from scripts.benchmarks import program as benchmark
from scripts.benchmarks.chain import Setup
from scripts.benchmarks.modes.cards import SERVERS, Card, cards, derived, measure_cards, table
from scripts.benchmarks.processes.relay import Delay
from scripts.demonstration.child import DemoError

SETUP = Setup(800, 1, 5.0, 1.0, 0, ppm=0.0)


def departures(delay: Delay, count: int, every_ns: int = 10_000) -> list[float]:
    """When frames leave that arrive at this interval, all of them under way at once."""
    for number in range(count):
        delay.put(bytes([number]), number * every_ns)
    left = []
    for number in range(count):
        left.append(delay.due_ns)
        assert delay.take() == bytes([number])
    assert delay.due_ns == float("inf")
    return left


def test_every_frame_is_delayed_alike() -> None:
    assert departures(Delay(400_000), 3) == [400_000, 410_000, 420_000]


def test_jitter_stays_in_its_limits_and_keeps_the_order() -> None:
    left = departures(Delay(400_000, 100_000, seed=1), 200)
    assert left == sorted(left)
    delays = [due - number * 10_000 for number, due in enumerate(left)]
    assert 300_000 <= min(delays) < 350_000, "no frame leaves earlier"
    assert 450_000 < max(delays) <= 500_000
    assert left == departures(Delay(400_000, 100_000, seed=1), 200)
    assert left != departures(Delay(400_000, 100_000, seed=2), 200)


def test_the_longest_round_trips_are_for_800_hz() -> None:
    assert {card.round_trip_ms for card in cards(800, ())} == {0.05, 0.44, 0.86, 2, 3}
    assert {card.round_trip_ms for card in cards(1600, ())} == {0.05, 0.44, 0.86, 2}
    assert [str(card) for card in cards(800, (0.05, 2.0))] == ["0.05 ms", "2 ms", "2 ms ± 200 µs"]


def figures() -> dict[str, Any]:
    return {
        "made": 4000, "arrivals": 3980, "lost": 40, "repeated": 20,
        "age_us": {"p50": 1290.0, "p99": 22_353.0}, "stamp_error_us": {"p50": -166.0, "p99_absolute": 4321.0},
    }  # fmt: skip


def status(cycles: int, uptime_s: float) -> dict[str, Any]:
    return {"cycles": cycles, "uptime_s": uptime_s, "last_10s": {"exchange_us": {"p50": 860.0}}}


def test_what_follows_from_a_recording_and_the_status() -> None:
    found = derived(figures(), Card(0.86), SETUP, status(1000, 3.0), status(13_000, 9.0))
    assert found["new_per_s"] == 792.0
    assert found["lost_percent"] == 1.0
    assert found["cycles_a_sample"] == 2.5
    assert found["age_by_best"] == 3.0


def test_a_row_for_each_server() -> None:
    more = derived(figures(), Card(2, 200), SETUP, status(0, 0.0), status(1600, 1.0))
    rows = [{"card": Card(2, 200)._asdict(), "server": name, **figures(), **more} for name in SERVERS]
    shown = io.StringIO()
    Console(width=100, file=shown).print(table(rows, "800 Hz"))
    lines = shown.getvalue().splitlines()
    assert sum("2 ms ± 200 µs" in line and "1290 / 22353" in line for line in lines) == len(SERVERS)
    assert not any("…" in line for line in lines), "it fits the narrowest table"


def test_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.parse([]).cards is None
    options = benchmark.parse(["--cards"])
    assert (options.cards, options.rates, options.sensors) == ((), [800, 1600], [1])
    options = benchmark.parse(["--cards", "0.05,3", "--rates", "800"])
    assert (options.cards, options.rates) == ([0.05, 3.0], [800])
    with pytest.raises(SystemExit):
        benchmark.parse(["--cards", "0.5"])
    assert "0.05, 0.44, 0.86, 2, 3" in capsys.readouterr().err
    two = replace(SETUP, sensors=2)
    with pytest.raises(DemoError, match="one sensor"):
        measure_cards([two], (), Console(quiet=True))
