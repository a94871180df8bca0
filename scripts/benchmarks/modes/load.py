"""How old samples are beside endless loops: when the server hands them out, at a TCP client, and in `wrench`
at a ROS 2 subscriber, each with ordinary and with real-time scheduling.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from protocol.client import Client
from scripts.benchmarks import statistics
from scripts.benchmarks.chain import PORT, Chain, Setup, chain, recording, start_server, virtual_bus
from scripts.benchmarks.statistics import Arrivals, Ints
from scripts.demonstration.child import Child

PRIORITY: Final = 40
"""Of the client, or of node and subscriber: the default of the node's `rt_priority`."""
_LOOP: Final = (
    "import sys, time\nend = time.monotonic() + float(sys.argv[1])\nwhile time.monotonic() < end: pass"
)
_START_S: Final = 120.0
"""A loop ends by itself after the measurement and this."""
_WRENCH: Final = "/wrench"


def start_loops(running: Chain, count: int) -> None:
    """Endless loops, each a process of its own."""
    seconds = running.setup.seconds + _START_S
    for number in range(count):
        command = [sys.executable, "-c", _LOOP, str(seconds)]
        running.children.append(Child(f"loop-{number}", command, running.directory))


def measure_tcp(setup: Setup, ifname: str, loops: int, priority: int) -> dict[str, Any]:
    """Server and TCP client."""
    with chain(setup) as running:
        running.start_canaries()
        link = start_server(running, ifname)
        path, arguments = recording(running, "client")
        how = ("--port", PORT, "--rt-priority", priority)
        running.start_recorder(path, "scripts.benchmarks.processes.client", *arguments, *how)
        start_loops(running, loops)
        return _figures(running, link, path)


def measure_ros(setup: Setup, ifname: str, loops: int, priority: int) -> dict[str, Any]:
    """Server, node and a subscriber of `wrench`."""
    with chain(setup) as running:
        running.start_canaries()
        link = start_server(running, ifname)
        given = ("-p", f"server_port:={PORT}", "-p", f"rt_priority:={priority}")
        running.start("node", "bridge.client", "--ros-args", *given)
        path, arguments = recording(running, "subscriber")
        how = ("--wrench", "--rt-priority", priority)
        running.start_recorder(path, "scripts.benchmarks.processes.subscriber", *arguments, *how, _WRENCH)
        start_loops(running, loops)
        return _figures(running, link, path)


def _figures(running: Chain, link: Client, path: Path) -> dict[str, Any]:
    """What is recorded; also without the samples that were on their way during a stall."""
    usage = running.record(path)
    status = link.ask("status")
    link.close()
    running.stop()
    figures, _ = running.figures(path)
    (arrivals,) = statistics.read_arrivals(path)
    outside = ~in_stalls(arrivals, running.stops())
    figures["age_outside_stalls_us"] = statistics.spread_us(statistics.ages(arrivals)[outside])
    figures["outside_stalls"] = int(np.count_nonzero(outside))
    figures["hand_out_us"] = status["sensors"][0]["age_us"]
    return {**figures, **usage}


def in_stalls(arrivals: Arrivals, stalls: Ints) -> NDArray[np.bool_]:
    """Whether each sample was on its way, from its instant to its arrival, during one of `stalls`."""
    if not len(stalls):
        return np.zeros(len(arrivals.instant), dtype=np.bool_)
    first_that_ends_later = np.searchsorted(stalls[:, 1], arrivals.instant)
    begins = np.append(stalls[:, 0], np.iinfo(np.int64).max)[first_that_ends_later]
    return np.asarray(begins < arrivals.received)


def measure_load(setup: Setup, loops: int, with_ros: bool, console: Console) -> dict[str, Any]:
    """Measure and print it. DemoError or Stopped end it early."""
    rows = {}
    with virtual_bus(setup) as (ifname, _):
        for to, measure in (("TCP", measure_tcp), ("wrench", measure_ros))[: 2 if with_ros else 1]:
            for how, priority in (("ordinary", 0), ("real-time", PRIORITY))[: 2 if setup.priority else 1]:
                rows[f"{to}, {how}"] = measure(setup, ifname, loops, priority)
    console.print(table(rows, setup.rate_hz, loops))
    return {"rate_hz": setup.rate_hz, "loops": loops, "priority": PRIORITY, "chains": rows}


def table(rows: dict[str, dict[str, Any]], rate_hz: int, loops: int) -> Table:
    """A row for each chain."""
    title = f"{rate_hz} Hz beside {loops} endless loops: ages in µs, p50 / p99 / p99.9"
    made = Table(title=title, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for name in ("", "lost (stalls)", "handed out", "on arrival", "outside stalls"):
        made.add_column(name, justify="right" if name else "left", no_wrap=True)
    for name, row in rows.items():
        ages = (row[key] for key in ("hand_out_us", "age_us", "age_outside_stalls_us"))
        lost = f"{row['lost']} ({row['lost_in_stops']})"
        made.add_row(name, lost, *map(points, ages))
    return made


def points(ages: Mapping[str, float] | None) -> str:
    """Median and tail of ages."""
    return " / ".join(f"{ages[point]:.0f}" for point in ("p50", "p99", "p999")) if ages else "-"
