"""What `scripts/benchmark` measures, as rows, and how a row is shown.

The comparison is of this project with a bare C program, with loops of pysoem and KickCAT and with Bota's
driver, on virtual sensors. This project and the C program alternate in short turns, so that the machine's
noise meets both. KickCAT's bindings and Bota's closed Python driver (packages kickcat and bota-driver) are no
dependencies of the project: scripts/benchmark installs them into .venv-vendor before the program enters its
network namespace.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import (
    PROCESSES,
    WARM_UP_S,
    Figures,
    MeasuredChain,
    Setup,
    Turn,
)
from scripts.benchmarks.processes.masters import build
from scripts.benchmarks.records import REAL_TIME
from scripts.chain import Child, ScriptError

_MAX_TURNS: Final = 3
_NONE: Final = "-"
VENDOR: Final = Path(__file__).parents[2] / ".venv-vendor"
# What the ROS packages set is not for another environment's Python, which has no package of this project.
_OTHER: Final = (
    "env", "-u", "LD_LIBRARY_PATH", "-u", "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
    f"PYTHONPATH={VENDOR.with_name('protocol')}", VENDOR / "bin" / "python", "-m",
)  # fmt: skip
THIS, C_CLIENT, BARE_C = "this", "this, C client", "bare C"
PYSOEM, KICKCAT, DRIVER, ROS = "pysoem", "KickCAT", "Bota's driver", "this, ROS"
_POLLERS: Final[Mapping[str, Sequence[object]]] = {
    PYSOEM: (sys.executable, "-m", f"{PROCESSES}.poller", "pysoem"),
    KICKCAT: (*_OTHER, f"{PROCESSES}.poller", "kickcat"),
    DRIVER: (*_OTHER, f"{PROCESSES}.poller", "bota_driver"),
}
_PACKAGES: Final = {KICKCAT: "kickcat", DRIVER: "bota-driver"}  # of scripts/benchmark --vendor
RATIOS: Final = {
    "age_p50": ("age_us", "p50"),
    "age_p99": ("age_us", "p99"),
    "age_p999": ("age_us", "p999"),
    "cpu": ("cpu_percent", "server"),
}


def _start(name: str, chain: MeasuredChain) -> Child:
    """Start what is compared; the recorder of what arrives."""
    setup, yardstick = chain.setup, Path(os.environ["DEMO_DIRECTORY"]) / "yardstick"
    if name in _POLLERS:  # with the server's priority, for which they do not ask
        how = (WARM_UP_S, setup.seconds, chain.bus(), setup.sinc, setup.rate_hz, setup.priority)
        return chain.start("server", *_POLLERS[name], chain.directory / "server", *how)
    if name == BARE_C:
        chain.master(yardstick)
    else:
        chain.server()
        chain.settle()
    if name == ROS:
        for position in range(setup.sensors):
            chain.node(REAL_TIME, position)
        return chain.recorder("ros", setup.sensors)
    return chain.recorder("tcp") if name == THIS else chain.recorder("c", yardstick, "client")


def turn(setup: Setup, name: str) -> Turn:
    """One run of what is compared."""
    with MeasuredChain(setup, name) as chain:
        recorder = _start(name, chain)
        return chain.measure(recorder, (lambda: _client(chain)) if name == ROS else None)


def _client(chain: MeasuredChain) -> Child:
    """The recorder of a client beside the subscriber: in C if that can be built, for less CPU time."""
    yardstick = Path(os.environ["DEMO_DIRECTORY"]) / "yardstick"
    how = ("c", yardstick, "client") if yardstick.exists() else ("tcp",)
    return chain.recorder(*how, warm_up_s=0.0)


def find_missing(others: Sequence[str]) -> dict[str, str]:
    """Build the C program; which of the others cannot be compared here, and why."""
    missing = {}
    try:
        build(Path(os.environ["DEMO_DIRECTORY"]))
    except ScriptError as error:
        missing[BARE_C] = str(error)
    for name in others:
        if not [*VENDOR.glob(f"has-{_PACKAGES[name]}*")]:
            missing[name] = f"{_PACKAGES[name]} could not be installed by scripts/benchmark"
    return missing


def compare(setup: Setup, with_others: bool) -> list[Figures]:
    """A row for each program."""
    others = [*_PACKAGES] if with_others and setup.sensors == 1 else []  # the driver knows one sensor only
    missing = find_missing(others)
    alternating = [THIS] if BARE_C in missing else [THIS, C_CLIENT, BARE_C]
    count = max(1, min(_MAX_TURNS, int(setup.seconds)))
    short = replace(setup, seconds=setup.seconds / count)
    rounds = [{name: turn(short, name) for name in alternating} for _ in range(count)]
    taken = {name: together([each[name] for each in rounds]) for name in alternating}
    last = [PYSOEM, *(name for name in others if name not in missing), *[ROS] * setup.ros]
    taken |= {name: turn(setup, name) for name in last}
    if BARE_C in taken:
        taken[C_CLIENT][0]["ratio"] = ratios(*([each[by] for each in rounds] for by in (C_CLIENT, BARE_C)))
    rows: list[Figures] = [{"program": name, **figures} for name, (figures, _) in taken.items()]
    rows += [{"program": name, "missing": why} for name, why in missing.items()]
    return [{"rate_hz": setup.rate_hz, "sensors": setup.sensors, **row} for row in rows]


def together(turns: Sequence[Turn]) -> Turn:
    """Counts are summed, ages pooled; of other figures it is the median."""
    figures, ages = [each for each, _ in turns], np.concatenate([each for _, each in turns])
    found: Figures = {}
    for name, first in figures[0].items():
        if isinstance(first, int):
            found[name] = sum(each[name] for each in figures)
        else:
            found[name] = {
                key: round(float(np.median([each[name][key] for each in figures])), 1) for key in first
            }
    return {**found, "age_us": statistics.spread_us(ages)}, ages


def ratios(ours: Sequence[Turn], theirs: Sequence[Turn]) -> dict[str, float]:
    """This project by the C program: median of the turns."""
    pairs = list(zip((a for a, _ in ours), (b for b, _ in theirs), strict=True))
    return {
        name: round(float(np.median([a[table][key] / b[table][key] for a, b in pairs])), 2)
        for name, (table, key) in RATIOS.items()
    }


def answer(rows: Sequence[Figures]) -> str:
    """The result of the comparison in a sentence, from the first configuration."""
    ages = {row["program"]: row["age_us"] for row in reversed(rows) if "age_us" in row}

    def age(name: str) -> str:
        return f"{ages[name]['p50']:,.0f} µs (p99 {ages[name]['p99']:,.0f})"

    others = {BARE_C: "A bare C program", DRIVER: "Bota's driver"}
    beside = "; ".join(f"{text}: {age(name)}" for name, text in others.items() if name in ages)
    return f"**Your controller gets a sample {age(THIS)} after it was measured.** {beside}."


def load(setup: Setup, loops: int) -> list[Figures]:
    """A row for each kind of client and of scheduling, beside endless loops."""
    rows = []
    for client in ("TCP", "wrench")[: 1 + setup.ros]:
        for how, priority in (("ordinary", 0), ("real-time", REAL_TIME))[: 1 + bool(setup.priority)]:
            with MeasuredChain(setup, f"{client}, {how}, beside {loops} loops") as chain:
                chain.server()
                chain.settle()
                if client == "wrench":
                    chain.node(priority)
                kind = ("ros", 1) if client == "wrench" else ("tcp",)
                recorder = chain.recorder(*kind, priority=priority)
                for number in range(loops):
                    chain.start(f"loop-{number}", sys.executable, "-c", "while True: pass")
                figures, _ = chain.measure(recorder)
            about = {"rate_hz": setup.rate_hz, "loops": loops, "chain": f"{client}, {how}"}
            rows.append({**about, **figures})
    return rows


def _shown(table: str, key: str, ratio: str = "") -> Callable[[Figures], str]:
    def show(row: Figures) -> str:
        value = row.get(table, {}).get(key)
        text = _NONE if value is None else f"{value:.{1 if value < 100 else 0}f}"
        return f"{text} ({row['ratio'][ratio]:.2f})" if ratio and "ratio" in row else text

    return show


def _lost(row: Figures) -> str:
    if "made" not in row:
        return str(row.get("missing", ""))
    after = f" ({row['lost_after_server']} after the server)" if "lost_after_server" in row else ""
    return f"{row['lost']} of {row['made']}{after}"


def _points(row: Figures, name: str) -> str:
    return " / ".join(f"{row[name][point]:.0f}" for point in ("p50", "p99", "p999"))


# Of the table of each, by heading: how a row is shown.
TABLES: Final[Mapping[str, Mapping[str, Callable[[Figures], str]]]] = {
    "comparison": {
        "sensors: program": lambda row: f"{row['rate_hz']} Hz, {row['sensors']}: {row['program']}",
        "lost": _lost,
        "repeated": lambda row: str(row.get("repeated", _NONE)),
        "age p50, µs": _shown("age_us", "p50", "age_p50"),
        "p99": _shown("age_us", "p99", "age_p99"),
        "p99.9": _shown("age_us", "p999", "age_p999"),
        "stamp error p99, µs": _shown("stamp_error_us", "p99"),
        "CPU, %": _shown("cpu_percent", "server", "cpu"),
        "settled after": lambda row: (
            f"{row['settled']['seconds']:.1f} s, {row['lost_settling']} lost" if "settled" in row else _NONE
        ),
    },
    "load": {
        "beside loops": lambda row: f"{row['rate_hz']} Hz, {row['loops']} loops: {row['chain']}",
        "lost": lambda row: str(row["lost"]),
        "handed out, µs": lambda row: _points(row, "hand_out_us"),
        "on arrival, µs": lambda row: _points(row, "age_us"),
    },
    "path": {
        "slave controller": lambda row: row["clock"],
        "clients": lambda row: str(row["clients"]),
        "source lines": lambda row: f"{row['lines']:.0f} / {row['mean_lines']:.0f}",
        "calls": lambda row: f"{row['calls']:.0f} / {row['mean_calls']:.0f}",
        "system calls": lambda row: f"{row['system_calls']:.0f} / {row['mean_system_calls']:.1f}",
    },
}
