"""The benchmark: what it makes of made-up records, its programs, and short runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts.benchmarks import modes, statistics
from scripts.benchmarks import program as benchmark
from scripts.benchmarks.chain import ScriptError, Turn
from scripts.benchmarks.records import ArrivalRecorder, began
from tests.server.running import needs_bus

ROOT = Path(__file__).parent.parent
PERIOD = 1_250_000


@pytest.mark.parametrize(
    ("numbers", "made", "lost"),
    [
        (range(5, 105), 100, 0),
        ((5, 6, 6, 7, 10, 11, 11, 11), 7, 2),
        ((5, 7, 6, 8), 4, 0),  # a late one is not lost
        (range(2**24 - 2, 2**24 + 3), 5, 0),
    ],
)
def test_what_is_lost_and_how_old_a_sample_is_when_it_comes_first(
    tmp_path: Path, numbers: Sequence[int], made: int, lost: int
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
    assert statistics.count(stream) == {"made": made, "lost": lost}
    figures, ages = statistics.summary([stream])
    assert ages.tolist() == [300] * (made - lost)
    assert figures["stamp_error_us"] == {"p99": 0.0}


def turn(median_us: float, lost: int, cpu: float) -> Turn:
    ages = np.array([median_us * 1000] * 3)
    counts = {"made": 100, "lost": lost}
    return {**counts, "age_us": statistics.spread_us(ages), "cpu_percent": {"server": cpu}}, ages


def test_turns_are_pooled_and_their_ratios_are_medians() -> None:
    ours = [turn(100, 1, 10), turn(120, 0, 12), turn(900, 5, 20)]
    theirs = [turn(100, 0, 5), turn(100, 0, 5), turn(450, 0, 5)]
    figures, ages = modes.together(ours)
    assert (figures["made"], figures["lost"], figures["cpu_percent"]["server"]) == (300, 6, 12.0)
    assert (figures["age_us"]["p50"], len(ages)) == (120.0, 9)
    found = modes.ratios(ours, theirs)
    assert (found["age_p50"], found["cpu"]) == (1.2, 2.4)


AGES = {"p50": 80.0, "p99": 120.0, "p999": 150.0}
ABOUT = {"rate_hz": 800, "sensors": 1}
COUNTS = {"made": 200, "lost": 1}
RATIOS = dict(zip(modes.RATIOS, (2, 3, 4, 5), strict=True))
ROWS: list[dict[str, Any]] = [
    {**ABOUT, "program": "this", **COUNTS, "age_us": AGES, "cpu_percent": {"server": 9.0}},
    {**ABOUT, "program": "this, C client", **COUNTS, "age_us": AGES, "ratio": RATIOS},
    {**ABOUT, "program": "bare C", **COUNTS, "age_us": {"p50": 40.0, "p99": 60.0}},
    {**ABOUT, "program": "Bota's driver", "missing": "it cannot be had"},
]


def test_the_page_is_renewed_between_its_comments(tmp_path: Path) -> None:
    load = {"loops": 4, "chain": "TCP, ordinary", "hand_out_us": AGES, "age_us": AGES}
    content = {
        "date": "2026-11-23T01:02:03", "cpus": 2, "kernel": "6.1.0-x", "python": "3.11.2",
        "idle_states": True, "comparison": ROWS, "load": [{**ABOUT, **COUNTS, **load}],
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
        assert "are of one run: 2026-11-23, 2 CPUs, Linux 6.1.0, Python 3.11.2, with idle states." in text
        assert "| 800 Hz, 1: this, C client | 1 of 200 | 80.0 (2.00) | 120 (3.00) | 150 (4.00) |" in text
        row = "| 800 Hz, 4 loops: TCP, ordinary | 1 | 80 / 120 / 150 | 80 / 120 / 150 |"
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
    done = subprocess.run(
        ["unshare", "--net", sys.executable, "-m", "scripts.benchmarks.program", *map(str, arguments)],
        cwd=ROOT, env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, check=False, timeout=400,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    text = Path(page).read_text()
    for what in ("400 Hz, 2: this, ROS", "400 Hz, 4 loops: wrench, "):
        assert f"| {what}" in text, what
    written = (tmp_path / "b.json").read_text()
    assert not re.search("NaN|Infinity", written)
    content = json.loads(written)
    programs = {(row["sensors"], row["program"]): row for row in content["comparison"]}
    for program in ("this", "bare C", "this, ROS"):
        if figures := programs.get((1, program)):
            assert figures["made"] > figures["lost"]
            assert 0 < figures["age_us"]["p50"] <= figures["age_us"]["p99"] <= figures["age_us"]["p999"]
            assert figures["cpu_percent"]["server"] > 0
