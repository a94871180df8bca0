"""What the ROS 2 node adds: the age of each sample at a subscriber of `wrench` beside its age at a TCP client
at the same time, and what the node takes.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import Chain, Figures, Setup
from scripts.benchmarks.modes.mode import Mode, points
from scripts.benchmarks.statistics import Arrivals


def measure(setup: Setup, _: Any) -> list[Figures]:
    """One row."""
    with Chain(setup, "the node, beside a TCP client") as chain:
        chain.server()
        chain.node()
        ros, tcp = chain.recorder("ros"), chain.recorder("tcp")
        one = chain.record(ros)
        chain.wait(tcp.result.exists, "the TCP client did not end")
        everything = chain.record(chain.recorder("ros", "--all"))
        (at_tcp,), (at_ros,) = (statistics.read_arrivals(each.result) for each in (tcp, ros))
    return [{"rate_hz": setup.rate_hz, **compare(at_tcp, at_ros), "one": one, "all": everything}]


def compare(tcp: Arrivals, ros: Arrivals) -> Figures:
    """Messages against the samples of the same number. Nothing may be missing, twice or different."""
    begin, end = (edge(tcp.number[at], ros.number[at]) for edge, at in ((max, 0), (min, -1)))
    samples = np.unique(tcp.number[(tcp.number >= begin) & (tcp.number <= end)])
    messages = ros.number[(ros.number >= begin) & (ros.number <= end)]
    _, at_tcp, at_ros = np.intersect1d(tcp.number, ros.number, return_indices=True)
    return {
        "samples": len(samples),
        "lost": len(np.setdiff1d(samples, messages)),
        "repeated": len(messages) - len(np.unique(messages)),
        "decoded_wrongly": int(np.count_nonzero(tcp.instant[at_tcp] != ros.instant[at_ros])),
        "tcp_age_us": statistics.spread_us(tcp.ages[at_tcp]),
        "ros_age_us": statistics.spread_us(ros.ages[at_ros]),
    }


MODE: Final = Mode(
    "only the ROS 2 node: ages beside a TCP client, CPU",
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
    },
    rates=(800, 1600),
    seconds=15.0,
    page=True,
)
