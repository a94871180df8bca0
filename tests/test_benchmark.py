"""The benchmark: what it makes of made-up records, its programs, and short runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts.benchmarks import modes, statistics
from scripts.benchmarks import program as benchmark
from scripts.benchmarks.chain import Turn, clocks_steady
from scripts.benchmarks.records import ArrivalRecorder, began, deadlines
from scripts.chain import ScriptError
from tests.ended import completed
from tests.server.running import needs_bus

ROOT = Path(__file__).parent.parent
PERIOD = 1_250_000


@pytest.mark.parametrize(
    ("numbers", "made", "lost", "repeated"),
    [
        (range(5, 105), 100, 0, 0),
        ((5, 6, 6, 7, 10, 11, 11, 11), 7, 2, 3),
        ((5, 7, 6, 8), 4, 0, 0),  # a late one is not lost
        (range(2**24 - 2, 2**24 + 3), 5, 0, 0),
    ],
)
def test_what_is_lost_and_how_old_a_sample_is_when_it_comes_first(
    tmp_path: Path, numbers: Sequence[int], made: int, lost: int, repeated: int
) -> None:
    """Also where numbers and instants of the signal begin anew."""
    wrap, begin = 2**20 * 10**9, 2**20 * 10**9 - 10 * PERIOD
    path, seen = tmp_path / "records", set[int]()
    records = []
    for number in numbers:
        instant = begin + number * PERIOD
        age = 300 if number not in seen else 300 + PERIOD
        seen.add(number)
        records.append([0, number % 2**24, instant % wrap, instant + 7, instant + age])
    np.array(records, dtype=np.int64).tofile(path)
    (stream,) = statistics.read_arrivals(path)
    assert statistics.count(stream) == {"made": made, "lost": lost, "repeated": repeated}
    figures, ages = statistics.summary([stream])
    assert ages.tolist() == [300] * (made - lost)
    assert figures["stamp_error_us"] == {"p99": 0.0}


def test_numbers_of_one_sample_or_none_miss_nothing() -> None:
    assert [statistics.span(statistics.unwrap(each)) for each in ([], [7], [7, 9])] == [
        (0, 0),
        (1, 0),
        (3, 1),
    ]


def arrivals(*numbers: int) -> statistics.Arrivals:
    found = np.array(numbers, dtype=np.int64)
    return statistics.Arrivals(found, found * PERIOD, found, found * PERIOD)


@pytest.mark.parametrize(
    ("subscriber", "client", "at_server", "after"),
    [
        ((5, 6, 7, 8), (5, 6, 7, 8), 0, 0),
        ((5, 6, 8, 11), (5, 6, 7, 8, 11), 2, 1),
        ((5, 8, 9), (7, 8, 9, 20), 0, 1),  # both recorded from 7 to 9
        ((5, 6, 8, 9), (6, 7, 8, 9, 11), 0, 1),
        ((5, 6, 7, 8), (5, 8), 0, 0),  # what the subscriber has was not lost at the server
        ((5, 6), (8, 9), 0, 0),
    ],
)
def test_losses_before_and_after_the_server_are_told_apart(
    subscriber: Sequence[int], client: Sequence[int], at_server: int, after: int
) -> None:
    found = statistics.lost_by_end([arrivals(*subscriber)] * 2, [arrivals(*client)] * 2)
    assert found == {"lost_at_server": 2 * at_server, "lost_after_server": 2 * after}


@pytest.mark.parametrize(
    ("clocks", "locked_s", "steady"),
    [
        ((("locked", "hardware"), ("locked", "hardware")), 0.0, True),
        ((("locked", "hardware"), ("oversampling", "hardware")), 9.0, False),
        ((("locked", "hardware"), ("locked", "polling")), 0.6, False),  # may be on trial
        ((("locked", "polling"),), 3.0, True),
    ],
)
def test_clocks_are_steady_once_they_are_locked_and_event_times_decided(
    clocks: Sequence[tuple[str, str]], locked_s: float, steady: bool
) -> None:
    status = [{"mode": mode, "stamps": stamps} for mode, stamps in clocks]
    assert clocks_steady(status, locked_s) is steady


def test_a_poller_leaves_out_the_instants_that_have_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    now, woken = [10_000_000], []
    monkeypatch.setattr("time.monotonic_ns", lambda: now[0])
    monkeypatch.setattr("time.sleep", lambda seconds: now.append(now.pop() + round(seconds * 1e9)))
    for _, work_ns in zip(deadlines(PERIOD), (100, 3 * PERIOD + 5, 0, 0), strict=False):
        woken.append((now[0] - 10_000_000) / PERIOD)
        now[0] += work_ns
    assert woken == [0, 1, 5, 6]


def turn(median_us: float, lost: int, cpu: float) -> Turn:
    ages = np.array([median_us * 1000] * 3)
    counts = {"made": 100, "lost": lost, "settled": {"seconds": cpu / 10}, "lost_settling": 1}
    return {**counts, "age_us": statistics.spread_us(ages), "cpu_percent": {"server": cpu}}, ages


def test_turns_are_pooled_and_their_ratios_are_medians() -> None:
    ours = [turn(100, 1, 10), turn(120, 0, 12), turn(900, 5, 20)]
    theirs = [turn(100, 0, 5), turn(100, 0, 5), turn(450, 0, 5)]
    figures, ages = modes.together(ours)
    assert (figures["made"], figures["lost"], figures["cpu_percent"]["server"]) == (300, 6, 12.0)
    assert (figures["age_us"]["p50"], len(ages)) == (120.0, 9)
    assert (figures["settled"]["seconds"], figures["lost_settling"]) == (1.2, 3)
    found = modes.ratios(ours, theirs)
    assert (found["age_p50"], found["cpu"]) == (1.2, 2.4)


AGES = {"p50": 80.0, "p99": 120.0, "p999": 150.0}
ABOUT = {"rate_hz": 800, "sensors": 1}
COUNTS = {"made": 200, "lost": 1, "repeated": 0}
SETTLED = {"settled": {"seconds": 0.52}, "lost_settling": 4}
RATIOS = dict(zip(modes.RATIOS, (2, 3, 4, 5), strict=True))
WAKES = {"before": {"p50": 20.4, "p99": 60.9}, "after": {"p50": 1200.0, "p99": 4000.0}}
ROWS: list[dict[str, Any]] = [
    {**ABOUT, "program": "this", **COUNTS, "age_us": AGES, "cpu_percent": {"server": 9.0}},
    {**ABOUT, "program": "this, C client", **COUNTS, "age_us": AGES, "ratio": RATIOS, **SETTLED},
    {**ABOUT, "program": "this, ROS", **COUNTS, "lost_after_server": 3, "age_us": AGES},
    {**ABOUT, "program": "bare C", **COUNTS, "age_us": {"p50": 40.0, "p99": 60.0}},
    {**ABOUT, "program": "Bota's driver", "missing": "it cannot be had"},
]


def test_the_page_is_renewed_between_its_comments(tmp_path: Path) -> None:
    load = {"loops": 4, "chain": "TCP, ordinary", "hand_out_us": AGES, "age_us": AGES}
    content = {
        "date": "2026-11-23T01:02:03", "cpus": 2, "kernel": "6.1.0-x", "python": "3.11.2",
        "idle_states": True, "wake_us": WAKES, "comparison": ROWS, "load": [{**ABOUT, **COUNTS, **load}],
    }  # fmt: skip
    page = tmp_path / "page.md"
    names = ("comparison", "load")
    blocks = "".join(f"<!-- measured: {name} -->\nold\n<!-- end -->\n" for name in names)
    page.write_text(f"above\n{blocks}below\n")
    for _ in range(2):
        benchmark.renew(page, content)
        text = page.read_text()
        assert text.startswith(
            "above\n<!-- measured: comparison -->\n**Your controller gets a sample 80 µs (p99 120)"
        )
        assert "A bare C program: 40 µs (p99 60)." in text
        assert "are of one run: 2026-11-23, 2 CPUs, Linux 6.1.0, Python 3.11.2, with idle states. A" in text
        assert "woke 20 µs (p99 61) late before the measurements, 1,200 µs (p99 4,000) after them." in text
        figures = "1 of 200|0|80.0 (2.00)|120 (3.00)|150 (4.00)|-|- (5.00)|0.5 s, 4 lost|"
        assert f"|800 Hz, 1: this, C client|{figures}\n" in text
        assert "|800 Hz, 1: this, ROS|1 of 200 (3 after the server)|0|" in text
        assert "|800 Hz, 1: Bota's driver|it cannot be had|-|-|" in text
        row = "|800 Hz, 4 loops: TCP, ordinary|1|80 / 120 / 150|80 / 120 / 150|"
        assert text.endswith(f"{row}\n<!-- end -->\nbelow\n")
    for wrong in ("no place", text * 2, text.replace("load", "others")):
        page.write_text(wrong)
        with pytest.raises(ScriptError, match="once for each of comparison, load"):
            benchmark.renew(page, content)
        assert page.read_text() == wrong
    benchmark.check(ROOT / "docs" / "benchmark.md")


def test_recording_begins_after_the_warm_up(tmp_path: Path) -> None:
    path = tmp_path / "records"
    recording = ArrivalRecorder(path, warm_up_s=1.0, seconds=2.0)
    times = iter(range(0, 10**10, 500_000_000))
    assert not began(path).exists()
    while recording.add(0, 0, 0, 0, next(times)):
        pass
    recording.write()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["records", "records.began"]
    assert np.fromfile(path, np.int64)[4::5].tolist() == [n * 500_000_000 for n in range(2, 7)]


@needs_bus
@pytest.mark.bus
@pytest.mark.long
@pytest.mark.ros
@pytest.mark.timeout(500)
def test_a_run_for_the_page_with_ros_and_two_sensors(tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    page = shutil.copy(ROOT / "docs" / "benchmark.md", tmp_path)
    arguments = ("--json", tmp_path / "b.json", "--seconds", "1", "--rates", "400", "--page", page)
    done = completed(
        "unshare", "--net", sys.executable, "-m", "scripts.benchmarks.program", *arguments, cwd=ROOT,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "TMPDIR": str(tmp_path)}, timeout=400,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    text = Path(page).read_text()
    for what in ("400 Hz, 2: this, ROS", "400 Hz, 4 loops: wrench, "):
        assert f"|{what}" in text, what
    written = (tmp_path / "b.json").read_text()
    assert not re.search("NaN|Infinity", written)
    content = json.loads(written)
    programs = {(row["sensors"], row["program"]): row for row in content["comparison"]}
    assert content["wake_us"]["before"]["p50"] > 0
    assert programs[1, "this, ROS"]["settled"]["seconds"] > 0
    assert "lost_at_server" in programs[2, "this, ROS"]
    for program in ("this", "bare C", "pysoem", "this, ROS"):
        if figures := programs.get((1, program)):
            assert figures["made"] > figures["lost"]
            assert 0 < figures["age_us"]["p50"] <= figures["age_us"]["p99"] <= figures["age_us"]["p999"]
            assert figures["cpu_percent"]["server"] > 0
