"""This project beside a bare C program, Bota's driver and the polling design, on virtual sensors.

This project and the C program alternate in short turns, so that the machine's noise meets both.
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
from scripts.benchmarks.chain import (
    PORT,
    PROCESSES,
    WARM_UP_S,
    Chain,
    Child,
    Figures,
    ScriptError,
    Setup,
    own_cpus,
)
from scripts.benchmarks.modes import vendor
from scripts.benchmarks.modes.mode import NONE, Mode, losses
from scripts.benchmarks.processes.polling import TOPIC
from scripts.benchmarks.processes.yardstick import build
from scripts.benchmarks.statistics import Floats

_MOST_TURNS: Final = 3
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
    """The server, with a TCP client in Python or in C."""
    with Chain(setup, C_CLIENT if program else THIS) as chain:
        link = chain.server(chain.bus())
        client = _c_client(chain, program) if program else chain.recorder("tcp", "--port", PORT)
        usage = chain.record(client)
        status = link.ask("status")
        link.close()
        usage["server"] = {
            name: status[name] for name in ("wake_us", "exchange_us", "missed_deadlines", "lost_frames")
        }
        return chain.figures(client, usage)


def _c_client(chain: Chain, program: Path) -> Child:
    path = chain.directory / "c-client"
    times = (WARM_UP_S, chain.setup.seconds)
    return chain.start("c-client", program, "client", PORT, path, *times, result=path, watch=False)


def _master(chain: Chain, module: str, *arguments: object) -> Child:
    """A program in place of the server, on its CPU."""
    path = chain.directory / "master"
    how = ("--ifname", chain.bus(), "--port", PORT, "--rate", chain.setup.rate_hz)
    child = chain.python("server", f"{PROCESSES}.{module}", *arguments, path, *how, result=path)
    os.sched_setaffinity(child.pid, own_cpus()[1:])
    return child


def _with_loop(turn: Turn, master: Child) -> Turn:
    """How late the master's loop woke, and how long its exchanges took, besides."""
    late, exchange = statistics.read_numbers(master.result, 2).astype(float).T
    loop = {"wake_us": statistics.spread_us(late), "exchange_us": statistics.spread_us(exchange)}
    return {**turn[0], "server": loop}, turn[1]


def bare_c(setup: Setup, program: Path) -> Turn:
    """The C program with its C client."""
    with Chain(setup, BARE_C) as chain:
        master = _master(chain, "yardstick", "--priority", setup.priority, program)
        client = _c_client(chain, program)
        return _with_loop(chain.figures(client, chain.record(client)), master)


def polling(setup: Setup, *, ros: bool) -> Turn:
    """The polling loop, with a polling client or node."""
    with Chain(setup, f"{POLLING}, ROS" if ros else POLLING) as chain:
        master = _master(chain, "polling", "server")
        how = ("--port", PORT, "--rate", setup.rate_hz)
        if ros:
            chain.python("node", f"{PROCESSES}.polling", "node", chain.directory, *how)
        client = chain.recorder("ros", "--arrays", TOPIC) if ros else chain.recorder("polling", *how)
        return _with_loop(chain.figures(client, chain.record(client)), master)


def project_ros(setup: Setup) -> Turn:
    """The server, a node for each sensor, and a ROS subscriber."""
    with Chain(setup, f"{THIS}, ROS") as chain:
        chain.server(chain.bus()).close()
        topics = [f"/benchmark_{position}" for position in range(setup.sensors)]
        for position, topic in enumerate(topics):
            chain.node(f"array_topic:={topic}", position=position)
        client = chain.recorder("ros", "--arrays", *topics)
        return chain.figures(client, chain.record(client))


def measure(setup: Setup, with_driver: bool) -> list[Figures]:
    """A row for each program; `ages` are all of its ages, in ns."""
    taken: dict[str, Turn] = {}
    result: list[Figures] = []
    missing: dict[str, str] = {}
    try:
        program = build(Path(os.environ["DEMO_DIRECTORY"]))
    except ScriptError as error:
        missing[BARE_C] = str(error)
        taken[THIS] = together(in_turns(setup, [project])[0])
    else:
        turns = in_turns(
            setup, [project, partial(project, program=program), partial(bare_c, program=program)]
        )
        taken |= dict(zip((THIS, C_CLIENT, BARE_C), map(together, turns), strict=True))
        found = ratios(turns[0], turns[2])
    one = setup.sensors == 1  # the others know one sensor only
    if with_driver and one:
        if vendor.installed():
            taken[DRIVER] = vendor.measure_driver(setup)
        else:
            missing[DRIVER] = f"{vendor.REQUIREMENT} could not be installed by scripts/benchmark"
    if one:
        taken[POLLING] = polling(setup, ros=False)
    if setup.ros:
        taken[f"{THIS}, ROS"] = project_ros(setup)
        if one:
            taken[f"{POLLING}, ROS"] = polling(setup, ros=True)
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


def ratios(ours: Sequence[Turn], theirs: Sequence[Turn]) -> dict[str, dict[str, float]]:
    """This project by the C program: median, smallest and largest of the turns."""
    found = {}
    for name, (table, key) in RATIOS.items():
        each = [a[table][key] / b[table][key] for (a, _), (b, _) in zip(ours, theirs, strict=True)]
        figures = {"median": np.median(each), "min": min(each), "max": max(each)}
        found[name] = {point: round(float(value), 2) for point, value in figures.items()}
    return found


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
            return f"{row['ratio'][ratio]['median']:.2f}" if ratio else ""
        value = (row.get(table) or {}).get(key)
        return NONE if value is None else f"{value:.{1 if value < 100 else 0}f}"

    return show


def _lost(row: Figures) -> str:
    if "made" not in row:
        return str(row.get("missing", ""))
    return f"{losses(row)} of {row['made']}"


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
