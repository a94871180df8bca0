"""What the ROS 2 node adds: the age of each sample at a subscriber of `wrench` beside its age at a TCP client
at the same time, what the node takes, and the age of the first message after an interruption.
"""

from __future__ import annotations

import os
import signal
from typing import Any, Final

import numpy as np

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import PORT, Chain, Child, Figures, Setup
from scripts.benchmarks.modes.mode import Mode, points
from scripts.benchmarks.records import began
from scripts.benchmarks.statistics import Arrivals

ROUNDS: Final = 3
_SETTLE_S: Final = 1.0
STOPS_S: Final = {"server": 3.0, "node": 2.0}


def measure(setup: Setup, _: Any) -> list[Figures]:
    """One row."""
    with Chain(setup, "the node, beside a TCP client") as chain:
        chain.server(chain.bus()).close()
        chain.node()
        ros, tcp = chain.recorder("ros"), chain.recorder("tcp", "--port", PORT)
        one = chain.record(ros)
        chain.wait(tcp.result.exists, "the TCP client did not end")
        everything = chain.record(chain.recorder("ros", "--all"))
        figures = compare(_arrivals(tcp), _arrivals(ros))
    waits = measure_waits(setup)
    return [{"rate_hz": setup.rate_hz, **figures, "one": one, "all": everything, "first_age_us": waits}]


def measure_waits(setup: Setup) -> dict[str, list[float]]:
    """Age, µs, of the first message after each kind of interruption, some rounds of each."""
    waits: dict[str, list[float]] = {"late subscriber": []}
    with Chain(setup, "the node, interrupted") as chain:
        chain.server(chain.bus()).close()
        chain.node()
        for _round in range(ROUNDS):
            late = chain.recorder("ros", "--depth", 1, warm_up_s=0, seconds=_SETTLE_S)
            chain.wait(late.result.exists, "nothing was received")
            waits["late subscriber"].append(first_after(_arrivals(late)))
            for name, pause_s in STOPS_S.items():
                child = next(each for each in chain.children if each.name == name)
                recorder = chain.recorder("ros", "--depth", 1, warm_up_s=0, seconds=pause_s + 2 * _SETTLE_S)
                chain.wait(began(recorder.result).exists, "nothing was received")
                chain.sleep(_SETTLE_S)
                os.kill(child.pid, signal.SIGSTOP)
                try:
                    chain.sleep(pause_s)
                finally:
                    os.kill(child.pid, signal.SIGCONT)
                chain.wait(recorder.result.exists, "the recording did not end")
                found = first_after(_arrivals(recorder), pause_s)
                waits.setdefault(f"{name} stopped for {pause_s:g} s", []).append(found)
    return waits


def _arrivals(recorder: Child) -> Arrivals:
    return statistics.read_arrivals(recorder.result)[0]


def compare(tcp: Arrivals, ros: Arrivals) -> Figures:
    """Messages against the samples of the same number. Nothing may be missing, twice or different."""
    begin, end = (edge(tcp.number[at], ros.number[at]) for edge, at in ((max, 0), (min, -1)))
    samples = np.unique(tcp.number[(tcp.number >= begin) & (tcp.number <= end)])
    messages = ros.number[(ros.number >= begin) & (ros.number <= end)]
    _, at_tcp, at_ros = np.intersect1d(tcp.number, ros.number, return_indices=True)
    figures: Figures = {
        "samples": len(samples),
        "lost": len(np.setdiff1d(samples, messages)),
        "repeated": len(messages) - len(np.unique(messages)),
        "decoded_wrongly": int(np.count_nonzero(tcp.instant[at_tcp] != ros.instant[at_ros])),
    }
    for name, arrivals, at in (("tcp", tcp, at_tcp), ("ros", ros, at_ros)):
        figures[f"{name}_age_us"] = statistics.spread_us(statistics.ages(arrivals)[at])
    return figures


def first_after(arrivals: Arrivals, pause_s: float = 0.0) -> float:
    """Age, µs, of the first message after the longest silence; of the very first without one."""
    gaps, first = np.diff(arrivals.received), 0
    if pause_s:
        assert gaps.max() > pause_s * 1e9 / 2, "there was no silence"
        first = int(gaps.argmax()) + 1
    return round(float(statistics.ages(arrivals)[first]) / 1e3, 1)


MODE: Final = Mode(
    "only the ROS 2 node: ages beside a TCP client, CPU, first message after a stop",
    measure,
    {
        "the node": lambda row: f"{row['rate_hz']} Hz",
        "lost / repeated / decoded wrongly": lambda row: (
            f"{row['lost']} / {row['repeated']} / {row['decoded_wrongly']} of {row['samples']}"
        ),
        "age at a subscriber p50 / p99, µs": lambda row: points(row["ros_age_us"], "p50", "p99"),
        "at a TCP client": lambda row: points(row["tcp_age_us"], "p50", "p99"),
        "CPU with one topic / all, %": lambda row: " / ".join(
            f"{row[topics]['cpu_percent']['node']:.1f}" for topics in ("one", "all")
        ),
        "memory, MB": lambda row: f"{row['all']['rss_mb']['node']:.0f}",
        "first message, ms: late subscriber / server / node stopped": lambda row: " / ".join(
            f"{max(ages) / 1000:.1f}" for ages in row["first_age_us"].values()
        ),
    },
    rates=(800, 1600),
    seconds=15.0,
    page=True,
)
