"""This project beside a bare C program, Bota's driver and the polling design, on virtual sensors.

This project and the C program alternate in short turns, so that the machine's noise meets both. Bota's closed
Python driver (package bota-driver) is no dependency of the project: scripts/benchmark installs it into
.venv-vendor before the program enters its network namespace.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import PROCESSES, WARM_UP_S, Chain, Child, Figures, ScriptError, Setup
from scripts.benchmarks.modes.mode import NONE, Mode, losses
from scripts.benchmarks.processes.masters import build
from scripts.benchmarks.statistics import Arrivals, Floats

_MOST_TURNS: Final = 3
VENDOR: Final = Path(__file__).parents[3] / ".venv-vendor"
# What the ROS packages in .venv set is not for another environment's Python.
_WITHOUT_ROS: Final = ("env", "-u", "LD_LIBRARY_PATH", "-u", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
THIS, C_CLIENT, BARE_C, BY_C = "this", "this, C client", "bare C", "this / C"
DRIVER, POLLING = "Bota's driver", "polling"
RATIOS: Final = {
    "age_p50": ("age_us", "p50"),
    "age_p99": ("age_us", "p99"),
    "age_p999": ("age_us", "p999"),
    "cpu": ("cpu_percent", "server"),
}
_SUMMED: Final = {
    *("made", "arrivals", "lost", "lost_in_stops", "repeated"),
    *("machine_stops", "missed_deadlines", "lost_frames"),
}

Turn = tuple[Figures, Floats]


def project(setup: Setup, program: Path | None = None) -> Turn:
    """The server, with a TCP client in Python, or in C by this program."""
    with Chain(setup, C_CLIENT if program else THIS) as chain:
        link = chain.server()
        client = chain.recorder("c", program, "client") if program else chain.recorder("tcp")
        usage = chain.record(client)
        status = link.ask("status")
        usage["server"] = {
            name: status[name] for name in ("wake_us", "exchange_us", "missed_deadlines", "lost_frames")
        }
        return chain.figures(client, usage)


def _with_loop(turn: Turn, master: Child) -> Turn:
    """How late the master's loop woke, and how long its exchanges took, besides."""
    late, exchange = statistics.read_numbers(master.result, 2).astype(float).T
    loop = {"wake_us": statistics.spread_us(late), "exchange_us": statistics.spread_us(exchange)}
    return {**turn[0], "server": loop}, turn[1]


def bare_c(setup: Setup, program: Path) -> Turn:
    """The C program with its C client."""
    with Chain(setup, BARE_C) as chain:
        master = chain.master(program, setup.priority)
        client = chain.recorder("c", program, "client")
        return _with_loop(chain.figures(client, chain.record(client)), master)


def polling(setup: Setup) -> Turn:
    """The polling loop, with a polling client."""
    with Chain(setup, POLLING) as chain:
        master = chain.master()
        client = chain.recorder("polling", "--rate", setup.rate_hz)
        return _with_loop(chain.figures(client, chain.record(client)), master)


def project_ros(setup: Setup) -> Turn:
    """The server, a node for each sensor, and a ROS subscriber."""
    with Chain(setup, f"{THIS}, ROS") as chain:
        chain.server()
        topics = [f"/benchmark_{position}" for position in range(setup.sensors)]
        for position, topic in enumerate(topics):
            chain.node(f"array_topic:={topic}", position=position)
        client = chain.recorder("ros", "--arrays", *topics)
        return chain.figures(client, chain.record(client))


def vendor(setup: Setup) -> Turn:
    """Bota's driver, with the server's priority, for which it does not ask; the ages of first returns."""
    with Chain(setup, DRIVER) as chain:
        path = chain.directory / "driver"
        driver = chain.start(
            "server", *_WITHOUT_ROS, VENDOR / "bin" / "python", "-m", f"{PROCESSES}.vendor_driver", path,
            WARM_UP_S, setup.seconds, chain.bus(), setup.sinc, setup.rate_hz, setup.priority, result=path,
        )  # fmt: skip
        figures, _ = chain.figures(driver, chain.record(driver))
        ages = first_ages(statistics.read_arrivals(path)[0])
    return {**figures, "age_us": statistics.spread_us(ages), "every_age_us": figures["age_us"]}, ages


def first_ages(arrivals: Arrivals) -> Floats:
    """How old each sample was when it arrived first, ns."""
    return arrivals.ages[np.unique(arrivals.number, return_index=True)[1]]


def measure(setup: Setup, with_driver: bool) -> list[Figures]:
    """A row for each program; `ages` are all of its ages, in ns."""
    taken: dict[str, Turn] = {}
    result: list[Figures] = []
    missing: dict[str, str] = {}
    found: dict[str, Any] = {}
    try:
        program = build(Path(os.environ["DEMO_DIRECTORY"]))
    except ScriptError as error:
        missing[BARE_C] = str(error)
        taken[THIS] = together(in_turns(setup, [project])[0])
    else:
        in_c = [partial(each, program=program) for each in (project, bare_c)]
        turns = in_turns(setup, [project, *in_c])
        taken |= dict(zip((THIS, C_CLIENT, BARE_C), map(together, turns), strict=True))
        found = ratios(turns[0], turns[2])
    one = setup.sensors == 1  # the others know one sensor only
    if with_driver and one:
        if [*VENDOR.glob("has-bota-driver*")]:
            taken[DRIVER] = vendor(setup)
        else:
            missing[DRIVER] = "bota-driver could not be installed by scripts/benchmark"
    if one:
        taken[POLLING] = polling(setup)
    if setup.ros:
        taken[f"{THIS}, ROS"] = project_ros(setup)
    about = {"rate_hz": setup.rate_hz, "sensors": setup.sensors}
    for name, (figures, ages) in taken.items():
        result.append({**about, "program": name, **figures, "ages": ages})
        if name == BARE_C:
            result.append({**about, "program": BY_C, "ratio": found})
    return [*result, *({**about, "program": name, "missing": why} for name, why in missing.items())]


def in_turns(setup: Setup, programs: Sequence[Callable[[Setup], Turn]]) -> list[list[Turn]]:
    """Each program's turns."""
    turns = max(1, min(_MOST_TURNS, int(setup.seconds)))
    short = replace(setup, seconds=setup.seconds / turns)
    rounds = [[program(short) for program in programs] for _ in range(turns)]
    return [list(each) for each in zip(*rounds, strict=True)]


def together(turns: Sequence[Turn]) -> Turn:
    """Counts are summed, ages pooled; of other figures it is the median, of the longest the longest."""
    ages = np.concatenate([each for _, each in turns])
    return {**_pool([figures for figures, _ in turns]), "age_us": statistics.spread_us(ages)}, ages


def _pool(values: Sequence[Any], name: str = "") -> Any:
    if isinstance(values[0], dict):
        return {key: _pool([value[key] for value in values], key) for key in values[0]}
    if not isinstance(values[0], int | float):
        return values[-1]
    if name in _SUMMED:
        return sum(values)
    if name == "max" or name.startswith("longest"):
        return max(values)
    return round(float(np.median(values)), 1)


def ratios(ours: Sequence[Turn], theirs: Sequence[Turn]) -> dict[str, float]:
    """This project by the C program: median of the turns."""
    pairs = list(zip((a for a, _ in ours), (b for b, _ in theirs), strict=True))
    return {
        name: round(float(np.median([a[table][key] / b[table][key] for a, b in pairs])), 2)
        for name, (table, key) in RATIOS.items()
    }


def answer(rows: Sequence[Figures]) -> str:
    """The result in a sentence, from the first configuration."""
    ages = {row["program"]: row["age_us"] for row in reversed(rows) if "age_us" in row}

    def age(name: str) -> str:
        return f"{ages[name]['p50']:,.0f} µs (p99 {ages[name]['p99']:,.0f})"

    others = {BARE_C: "A bare C program", DRIVER: "Bota's driver", POLLING: "polling at a fixed rate"}
    beside = "; ".join(f"{text}: {age(name)}" for name, text in others.items() if name in ages)
    return f"**Your controller gets a sample {age(THIS)} after it was measured.** {beside}."


def _shown(table: str, key: str, ratio: str = "") -> Callable[[Figures], str]:
    def show(row: Figures) -> str:
        if "ratio" in row:
            return f"{row['ratio'][ratio]:.2f}" if ratio else ""
        value = (row.get(table) or {}).get(key)
        return NONE if value is None else f"{value:.{1 if value < 100 else 0}f}"

    return show


def _lost(row: Figures) -> str:
    return f"{losses(row)} of {row['made']}" if "made" in row else str(row.get("missing", ""))


MODE: Final = Mode(
    "",
    measure,
    {
        "sensors": lambda row: f"{row['rate_hz']} Hz, {row['sensors']}",
        "": lambda row: row["program"],
        "lost (in stalls)": _lost,
        "age p50, µs": _shown("age_us", "p50", "age_p50"),
        "p99": _shown("age_us", "p99", "age_p99"),
        "p99.9": _shown("age_us", "p999", "age_p999"),
        "stamp error p99, µs": _shown("stamp_error_us", "p99_absolute"),
        "CPU, %": _shown("cpu_percent", "server", "cpu"),
        "memory, MB": _shown("rss_mb", "server"),
    },
    rates=(800, 1600),
    sensors=(1, 2),
)
