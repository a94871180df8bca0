"""The benchmark with SDO traffic: what it makes of a recording, and its command line."""

from __future__ import annotations

from array import array
from pathlib import Path

import pytest

pytest.importorskip("numpy")

import numpy as np

from ethercat_server.virtual_sensor.signals import REST_LENGTH, RestSignal, decode_rest
from scripts import _benchmark as benchmark
from scripts import _benchmark_records as records
from scripts._benchmark_chain import Setup
from scripts._benchmark_sdo import instants, judge, late, read_half

PERIOD_NS = 1_250_000
NO_STOPS = np.empty((0, 2), dtype=np.int64)


def record(path: Path, numbers: list[int], delays: dict[int, int]) -> Path:
    """A recording: each number arrives 100 µs after its sample came to be, and by `delays` later."""
    rows = array("q")
    for number in numbers:
        received = 10**12 + number * PERIOD_NS + 100_000 + delays.get(number, 0)
        rows.extend((0, number % REST_LENGTH, 0, 0, received))
    records.write(path, rows)
    return path


def test_every_number_is_read_back_from_the_temperature() -> None:
    signal = RestSignal()
    for number in (0, 1, 2, 12345, REST_LENGTH - 1, REST_LENGTH + 7):
        temperature = float(np.float32(signal.reading(number, 0, 0.0).temperature))
        assert decode_rest(temperature) == number % REST_LENGTH


def test_what_is_lost_repeated_and_late_is_counted(tmp_path: Path) -> None:
    start = REST_LENGTH - 5  # the number begins anew in between
    numbers = [start + n for n in range(20) if n != 8]
    numbers.insert(4, numbers[3])
    late_by = {start + 10: 2 * PERIOD_NS, start + 12: 3 * PERIOD_NS, start + 14: PERIOD_NS // 2}
    path = record(tmp_path / "half", numbers, late_by)
    stop = 10**12 + (start + 12) * PERIOD_NS
    stopped = np.array([[stop, stop + 3 * PERIOD_NS]])
    found = judge(path, Setup(800, 1, 1.0, 0.0, 0, ppm=0.0), stopped)
    assert (found["made"], found["lost"], found["repeated"]) == (20, 1, 1)
    assert (found["late"], found["late_in_stops"]) == (2, 2)
    arrivals = read_half(path, PERIOD_NS)
    assert late(arrivals, PERIOD_NS, NO_STOPS) == (2, 0)
    assert np.array_equal(arrivals.instant, instants(arrivals.number, arrivals.received, PERIOD_NS))
    assert found["age_us"]["max"] == 3 * PERIOD_NS / 1000


def test_it_is_measured_on_one_configuration() -> None:
    options = benchmark.parse(["--sdo"])
    assert (options.sdo, options.rates, options.sensors) == (True, [800], [1])
