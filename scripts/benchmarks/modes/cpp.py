"""How old a sample is when the C++ client has it, against a bare read of the same bytes over loopback.

`pair` has a sender that stamps each message just before it sends it, so that the age is the way through
loopback and client, nothing else. `server` has the samples of ethercat-server: there the age begins in the
sensor.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.benchmarks.chain import PORT, Chain, Figures, ScriptError, Setup
from scripts.benchmarks.modes.mode import Mode, points
from scripts.benchmarks.statistics import spread_us

_ROOT: Final = Path(__file__).parents[3]
_WAYS: Final = ("waiting", "polling")
_WHO: Final = ("bare", "client")


def build(folder: Path) -> Path:
    """The benchmark's C++ program, optimized. ScriptError if it cannot be built."""
    if shutil.which("g++") is None:
        raise ScriptError("the C++ client is measured with a program built by g++: sudo apt install g++")
    program = folder / "benchmark_cpp"
    source = str(Path(__file__).with_suffix(".cpp"))
    command = ["g++", "-std=c++17", "-O2", f"-I{_ROOT / 'clients/cpp/include'}", source, "-o", str(program)]
    made = subprocess.run(command, check=False, capture_output=True, text=True)
    if made.returncode:
        raise ScriptError(f"g++ could not build the C++ benchmark:\n{made.stderr}")
    return program


def run(command: Sequence[object], seconds: float) -> list[Figures]:
    """Run the C++ program; its ages. ScriptError if it fails."""
    try:
        done = subprocess.run(
            list(map(str, command)), check=False, capture_output=True, text=True, timeout=3 * seconds + 30
        )
    except subprocess.TimeoutExpired:
        raise ScriptError("the C++ benchmark did not end") from None
    if done.returncode:
        raise ScriptError(done.stderr.strip() or f"the C++ benchmark ended with {done.returncode}")
    return figures(done.stdout.splitlines())


def figures(lines: Iterable[str]) -> list[Figures]:
    """For each way: spread of the ages by who read, in µs, and client / bare."""
    ages: dict[tuple[str, str], list[float]] = {(way, who): [] for way in _WAYS for who in _WHO}
    for line in lines:
        way, who, age_ns = line.split()
        ages[way, who].append(float(age_ns))
    rows: list[Figures] = []
    for way in _WAYS:
        bare, client = (spread_us(np.array(ages[way, who])) for who in _WHO)
        if bare is None or client is None:
            raise ScriptError(f"too few samples while {way}: measure for longer")
        ratio = {point: round(client[point] / bare[point], 2) for point in ("p50", "p99")}
        samples = len(ages[way, "client"])
        rows.append({"way": way, "bare_us": bare, "client_us": client, "ratio": ratio, "samples": samples})
    return rows


def measure(setup: Setup, _: Any) -> list[Figures]:
    """A row for each sender and way."""
    with Chain(setup, "the C++ client") as chain:
        program, seconds = build(chain.directory), max(8.0, 2 * setup.seconds)
        # Twice the rate: every second message is the client's.
        found = {"a bare sender": run((program, "pair", 2 * setup.rate_hz, setup.seconds), setup.seconds)}
        chain.server(chain.bus()).close()
        found["ethercat-server"] = run((program, "server", PORT, seconds), seconds)
    return [{"sender": sender, **row} for sender, rows in found.items() for row in rows]


MODE: Final = Mode(
    "only the C++ client, against a bare read",
    measure,
    {
        "the C++ client": lambda row: f"{row['sender']}, {row['way']}",
        "bare p50 / p99 / p99.9, µs": lambda row: points(row["bare_us"], digits=1),
        "client": lambda row: points(row["client_us"], digits=1),
        "client / bare p50 / p99": lambda row: points(row["ratio"], "p50", "p99", digits=2),
    },
)
