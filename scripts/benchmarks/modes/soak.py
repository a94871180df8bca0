"""The soak: only the server, for long. Does it lose samples, and does its memory grow?"""

from __future__ import annotations

import contextlib
import time
from dataclasses import replace
from typing import Final

import numpy as np

from scripts.benchmarks.chain import PORT, Chain, Figures, Setup, Stopped, Usage
from scripts.benchmarks.modes.comparison import Turn, together
from scripts.benchmarks.modes.mode import Mode, losses, points
from scripts.benchmarks.statistics import Floats

_TURNS: Final = 10
_LONGEST_TURN_S: Final = 60.0
_SETTLED: Final = 0.1  # the memory of this first part of the time does not count: caches still fill


def slope_kb_per_hour(seconds: Floats, rss: Floats) -> float:
    """How fast memory grows: a straight line through it, once settled."""
    settled = seconds >= seconds[0] + _SETTLED * (seconds[-1] - seconds[0])
    return float(np.polyfit(seconds[settled], rss[settled], 1)[0]) * 3600 / 1000


def measure(setup: Setup, minutes: float) -> list[Figures]:
    """One row. Stopped ends it with what there is."""
    seconds = minutes * 60
    setup = replace(setup, seconds=min(_LONGEST_TURN_S, seconds / _TURNS))
    turns: list[Turn] = []
    memory: list[tuple[float, float]] = []
    with Chain(setup, f"the server, for {minutes:g} minutes") as chain:
        chain.server(chain.bus()).close()
        server = chain.watched["server"]
        began = time.monotonic()
        with contextlib.suppress(Stopped):
            while time.monotonic() < began + seconds:
                with Chain(setup) as turn:
                    turn.canaries()
                    turn.watched["server"] = server
                    recorder = turn.recorder("tcp", "--port", PORT)
                    usage = turn.record(recorder)
                    turns.append((turn.figures(recorder, usage)[0], np.empty(0)))
                    memory.append((time.monotonic() - began, float(Usage(server).rss())))
        if len(memory) < _TURNS // 2:
            raise Stopped
    figures, _ = together(turns)
    at, rss = np.array(memory).T
    return [{
        "seconds": round(at[-1], 1), "rate_hz": setup.rate_hz, "sensors": setup.sensors, **figures,
        "age_us": turns[-1][0]["age_us"], "rss_slope_kb_per_hour": round(slope_kb_per_hour(at, rss), 1) + 0.0,
    }]  # fmt: skip


MODE: Final = Mode(
    "only the server: losses, memory",
    measure,
    {
        "soak": lambda row: f"{row['seconds']:.0f} s, {row['rate_hz']} Hz, {row['sensors']}",
        "lost (in stalls)": losses,
        "of": lambda row: str(row["made"]),
        "repeated": lambda row: str(row["repeated"]),
        "age, µs (the last turn)": lambda row: points(row["age_us"]),
        "CPU, %": lambda row: f"{row['cpu_percent']['server']}",
        "memory, MB": lambda row: f"{row['rss_mb']['server']}",
        "grows by, kB/h": lambda row: f"{row['rss_slope_kb_per_hour']}",
    },
    argument={"type": float, "metavar": "MINUTES"},
)
