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
from rich.console import Console

from scripts.benchmarks.chain import PORT, Setup, chain, start_server, virtual_bus
from scripts.benchmarks.statistics import spread_us
from scripts.demonstration.child import DemoError

_ROOT: Final = Path(__file__).parents[3]
_WAYS: Final = ("waiting", "polling")
_WHO: Final = ("bare", "client")


def build(folder: Path) -> Path:
    """The benchmark's C++ program, optimised. DemoError if it cannot be built."""
    if shutil.which("g++") is None:
        raise DemoError("the C++ client is measured with a program built by g++: sudo apt install g++")
    program = folder / "benchmark_cpp"
    command = ["g++", "-std=c++17", "-O2", f"-I{_ROOT / 'clients/cpp/include'}"]
    made = subprocess.run(
        [*command, str(_ROOT / "scripts/benchmarks/modes/cpp.cpp"), "-o", str(program)],
        check=False,
        capture_output=True,
        text=True,
    )
    if made.returncode:
        raise DemoError(f"g++ could not build the C++ benchmark:\n{made.stderr}")
    return program


def run(command: Sequence[str], seconds: float) -> dict[str, Any]:
    """Run the C++ program; its ages. DemoError if it fails."""
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=3 * seconds + 30)
    except subprocess.TimeoutExpired:
        raise DemoError("the C++ benchmark did not end") from None
    if done.returncode:
        raise DemoError(done.stderr.strip() or f"the C++ benchmark ended with {done.returncode}")
    return figures(done.stdout.splitlines())


def figures(lines: Iterable[str]) -> dict[str, Any]:
    """Spread of the ages by way and by who read, in µs, and client / bare."""
    ages: dict[tuple[str, str], list[float]] = {(way, who): [] for way in _WAYS for who in _WHO}
    for line in lines:
        way, who, age_ns = line.split()
        ages[way, who].append(float(age_ns))
    result: dict[str, Any] = {}
    for way in _WAYS:
        bare, client = (spread_us(np.array(ages[way, who])) for who in _WHO)
        if bare is None or client is None:
            raise DemoError(f"too few samples while {way}: measure for longer")
        ratio = {point: round(client[point] / bare[point], 2) for point in ("p50", "p99")}
        result[way] = {
            "bare_us": bare,
            "client_us": client,
            "ratio": ratio,
            "samples": len(ages[way, "client"]),
        }
    return result


def measure_cpp(setup: Setup, console: Console) -> dict[str, Any]:
    """Measure and print it. DemoError or Stopped end it early."""
    with virtual_bus(setup) as (ifname, _), chain(setup) as running:
        program = str(build(running.directory))
        # Twice the rate: every second message is the client's.
        result = {"pair": run([program, "pair", str(2 * setup.rate_hz), str(setup.seconds)], setup.seconds)}
        show("a bare sender", result["pair"], console)
        link = start_server(running, ifname)
        seconds = max(8.0, 2 * setup.seconds)
        result["server"] = run([program, "server", str(PORT), str(seconds)], seconds)
        link.close()
        show("ethercat-server", result["server"], console)
    return result


def show(sender: str, result: dict[str, Any], console: Console) -> None:
    """A line for each way."""
    for way in _WAYS:
        row = result[way]
        texts = [
            f"{who} " + " / ".join(f"{row[who + '_us'][point]:.1f}" for point in ("p50", "p99", "p999"))
            for who in _WHO
        ]
        console.print(
            f"{sender:16} {way}: age {', '.join(texts)} µs (p50 / p99 / p99.9); "
            f"client / bare {row['ratio']['p50']} (p50), {row['ratio']['p99']} (p99)",
            soft_wrap=True,
        )
