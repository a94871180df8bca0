"""The server under conditions: beside endless loops, for long."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Final

import numpy as np

from scripts.benchmarks.chain import Chain, Figures, Setup
from scripts.benchmarks.modes.mode import Mode, losses, points
from scripts.benchmarks.statistics import Floats

REAL_TIME: Final = 40  # of the client, or of node and subscriber: the default of the node's `rt_priority`
_SETTLED: Final = 0.1  # the memory of this first part of the time does not count: caches still fill


def load(setup: Setup, loops: int) -> list[Figures]:
    """A row for each kind of client and of scheduling, beside endless loops."""
    rows = []
    for client in ("TCP", "wrench")[: 1 + setup.ros]:
        for how, priority in (("ordinary", 0), ("real-time", REAL_TIME))[: 1 + bool(setup.priority)]:
            with Chain(setup, f"{client}, {how}, beside {loops} loops") as chain:
                link = chain.server()
                if client == "wrench":
                    chain.node(f"rt_priority:={priority}")
                    recorder = chain.recorder("ros", "--rt-priority", priority)
                else:
                    recorder = chain.recorder("tcp", "--rt-priority", priority)
                for number in range(loops):
                    chain.start(f"loop-{number}", sys.executable, "-c", "while True: pass", watch=False)
                usage = chain.record(recorder)
                handed_out = link.ask("status")["sensors"][0]["age_us"]
                figures, _ = chain.figures(recorder, usage)
            about = {"rate_hz": setup.rate_hz, "loops": loops, "chain": f"{client}, {how}"}
            rows.append({**about, **figures, "hand_out_us": handed_out})
    return rows


def soak(setup: Setup, minutes: float) -> list[Figures]:
    """One row: does the server lose samples for long, and does its memory grow?"""
    memory: list[tuple[float, float]] = []
    with Chain(replace(setup, seconds=minutes * 60), f"the server, for {minutes:g} minutes") as chain:
        chain.server()
        recorder = chain.recorder("tcp")
        figures, _ = chain.figures(recorder, chain.record(recorder, memory))
    slope = round(slope_kb_per_hour(*np.array(memory).T), 1) + 0.0
    about = {"seconds": minutes * 60, "rate_hz": setup.rate_hz, "sensors": setup.sensors}
    return [{**about, **figures, "rss_slope_kb_per_hour": slope}]


def slope_kb_per_hour(seconds: Floats, rss: Floats) -> float:
    """How fast memory grows: a straight line through it, once settled."""
    settled = seconds >= seconds[0] + _SETTLED * (seconds[-1] - seconds[0])
    return float(np.polyfit(seconds[settled] - seconds[0], rss[settled], 1)[0]) * 3600 / 1000


LOAD: Final = Mode(
    "only ages beside N endless loops, ordinary and real-time",
    load,
    {
        "beside loops": lambda row: f"{row['rate_hz']} Hz, {row['loops']} loops: {row['chain']}",
        "lost (in stalls)": losses,
        "handed out, µs": lambda row: points(row["hand_out_us"]),
        "on arrival, µs": lambda row: points(row["age_us"]),
    },
    argument={"type": int, "choices": range(1, 65), "metavar": "N"},
    page=4,
)
SOAK: Final = Mode(
    "only the server: losses, memory",
    soak,
    {
        "soak": lambda row: f"{row['seconds']:.0f} s, {row['rate_hz']} Hz, {row['sensors']}",
        "lost (in stalls)": losses,
        "of": lambda row: str(row["made"]),
        "repeated": lambda row: str(row["repeated"]),
        "age, µs": lambda row: points(row["age_us"]),
        "CPU, %": lambda row: f"{row['cpu_percent']['server']}",
        "memory, MB": lambda row: f"{row['rss_mb']['server']}",
        "grows by, kB/h": lambda row: f"{row['rss_slope_kb_per_hour']}",
    },
    argument={"type": float, "metavar": "MINUTES"},
)
