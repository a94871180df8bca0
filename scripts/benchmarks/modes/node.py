"""What the ROS 2 node adds: the age of each sample at a subscriber beside its age at a TCP client
that listens at the same time, what the node takes, and what comes first after everybody had to wait.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table

from scripts.benchmarks.chain import PORT, Chain, CpuUse, Setup, chain, start_server, virtual_bus
from scripts.benchmarks.processes.node_client import COLUMNS
from scripts.benchmarks.records import began
from scripts.benchmarks.statistics import Ints, read_numbers
from scripts.demonstration.child import Child

_STAMP, _INSTANT, _VALUES, _ARRIVAL = range(COLUMNS)
RATES: Final = (800, 1600)
WAITS: Final = ("late subscriber", "server stopped for 3 s", "node stopped for 2 s")
ROUNDS: Final = 3
_SETTLE_S: Final = 1.0
_FRESH_US: Final = 5000.0
_EDGE_NS: Final = 200_000_000
"""At either end of a recording one process may have begun or ended before the other."""


class Run:
    """Server and node on a virtual bus, and whoever listens."""

    def __init__(self, running: Chain, ifname: str) -> None:
        self.running = running
        self.client = start_server(running, ifname)
        self.server = running.children[-1]
        self.node = running.start("node", "bridge.client", "--ros-args", "-p", f"server_port:={PORT}")
        running.watch("node", self.node.pid)

    def listen(self, what: str, number: int = 0) -> tuple[Child, Path]:
        """Start a recorder and wait for its first sample."""
        path = self.running.directory / f"{what}-{number}"
        child = self.running.start_recorder(
            path, "scripts.benchmarks.processes.node_client", what, path, "--port", PORT
        )
        self.running.wait(lambda: began(path).exists(), f"{what}: nothing was received")
        return child, path

    def pass_time(self, seconds: float) -> None:
        """Let it run."""
        ending = time.monotonic() + seconds
        self.running.wait(lambda: time.monotonic() > ending, "", seconds + 5)

    def read(self, recorder: tuple[Child, Path]) -> Ints:
        """End a recorder; what it noted."""
        child, path = recorder
        child.stop()
        self.running.children.remove(child)
        return np.asarray(read_numbers(path, COLUMNS))

    def usage(self, seconds: float) -> dict[str, float]:
        """CPU in percent of one, and memory, of the node over this time."""
        node = self.running.watched["node"]
        use = CpuUse(node)
        rss = node.memory_info().rss
        self.pass_time(seconds)
        percent = use.percent()
        after = node.memory_info().rss
        return {
            "cpu_percent": percent,
            "rss_mb": round(after / 1e6, 1),
            "rss_growth_kb": round((after - rss) / 1e3, 1),
        }


@contextlib.contextmanager
def started(setup: Setup) -> Iterator[Run]:
    """Server and node."""
    with virtual_bus(setup) as (ifname, _), chain(setup) as running:
        yield Run(running, ifname)


def compare(tcp: Ints, ros: Ints) -> dict[str, Any]:
    """Messages against the samples with the same stamp. Nothing may be missing, twice or different."""
    begin = max(tcp[0, _ARRIVAL], ros[0, _ARRIVAL]) + _EDGE_NS
    end = min(tcp[-1, _ARRIVAL], ros[-1, _ARRIVAL]) - _EDGE_NS
    inside = tcp[(tcp[:, _ARRIVAL] > begin) & (tcp[:, _ARRIVAL] < end)]
    stamps, where = np.unique(ros[:, _STAMP], return_index=True)
    position = np.searchsorted(stamps, inside[:, _STAMP])
    found = (position < len(stamps)) & (stamps[np.minimum(position, len(stamps) - 1)] == inside[:, _STAMP])
    there, messages = inside[found], ros[where[position[found]]]
    at_tcp = (there[:, _ARRIVAL] - there[:, _INSTANT]) / 1e3
    at_ros = (messages[:, _ARRIVAL] - there[:, _INSTANT]) / 1e3
    figures: dict[str, Any] = {
        "samples": len(inside),
        "lost": int(np.count_nonzero(~found)),
        "repeated": len(ros) - len(stamps),
        "decoded_wrongly": int(np.count_nonzero(there[:, _VALUES] != messages[:, _VALUES])),
    }
    for name, ages in (("tcp", at_tcp), ("ros", at_ros)):
        figures[f"{name}_age_us"] = {p: round(float(np.percentile(ages, p)), 1) for p in (50, 99, 99.9)}
    return figures


def measure_rate(setup: Setup, seconds: float) -> dict[str, Any]:
    """One rate: ages with one subscribed topic; what the node takes with one and with all of them."""
    with started(setup) as run:
        tcp, wrench = run.listen("tcp"), run.listen("wrench")
        run.pass_time(_SETTLE_S)
        one_topic = run.usage(seconds)
        noted = run.read(wrench), run.read(tcp)
        everything = run.listen("all")
        run.pass_time(_SETTLE_S)
        all_topics = run.usage(seconds)
        run.read(everything)
        run.client.close()
    return {"rate_hz": setup.rate_hz, **compare(noted[1], noted[0]), "one": one_topic, "all": all_topics}


def first_after(recorded: Ints, tcp: Ints, pause_ns: int) -> float:
    """Age, µs, of the first message after the longest silence; of the very first without one."""
    arrivals = recorded[:, _ARRIVAL]
    gaps = np.diff(arrivals)
    first = recorded[0]
    if pause_ns:
        assert gaps.max() > pause_ns / 2, "there was no silence"
        first = recorded[int(gaps.argmax()) + 1]
    instant = tcp[tcp[:, _STAMP] == first[_STAMP]][0, _INSTANT]
    return round(float(first[_ARRIVAL] - instant) / 1e3, 1)


def measure_waits(setup: Setup) -> dict[str, list[float]]:
    """Age of the first message after each kind of waiting, some rounds of each."""
    ages: dict[str, list[float]] = {name: [] for name in WAITS}
    with started(setup) as run:
        tcp = run.listen("tcp")
        rows: dict[str, list[tuple[Ints, int]]] = {name: [] for name in WAITS}
        for number in range(ROUNDS):
            stops: tuple[tuple[str, Callable[[], None], int], ...] = (
                (WAITS[0], lambda: None, 0),
                (WAITS[1], lambda: _stop(run, run.server, 3.0), 3_000_000_000),
                (WAITS[2], lambda: _stop(run, run.node, 2.0), 2_000_000_000),
            )
            for name, act, pause_ns in stops:
                wrench = run.listen("newest", 10 * number + WAITS.index(name))
                run.pass_time(_SETTLE_S)
                act()
                run.pass_time(_SETTLE_S)
                rows[name].append((run.read(wrench), pause_ns))
        noted = run.read(tcp)
        run.client.close()
    for name, recordings in rows.items():
        ages[name] = [first_after(recorded, noted, pause_ns) for recorded, pause_ns in recordings]
    return ages


def _stop(run: Run, child: Child, seconds: float) -> None:
    os.kill(child.pid, signal.SIGSTOP)
    try:
        run.pass_time(seconds)
    finally:
        os.kill(child.pid, signal.SIGCONT)


def measure_node(setup: Setup, console: Console) -> dict[str, Any]:
    """Measure and print it. DemoError or Stopped end it early."""
    rows = [measure_rate(replace(setup, rate_hz=rate), setup.seconds) for rate in RATES]
    waits = measure_waits(setup)
    table = Table(title="the node, beside a TCP client at the same time")
    table.add_column("")
    for row in rows:
        table.add_column(f"{row['rate_hz']} Hz", justify="right")
    for title, text in _LINES:
        table.add_row(title, *(text(row) for row in rows))
    console.print(table)
    for name, ages in waits.items():
        late = sum(age > _FRESH_US for age in ages)
        console.print(
            f"first message, {name}: {', '.join(map(str, ages))} µs old" + f"; {late} late" * (late > 0)
        )
    return {"rates": rows, "first_message_age_us": waits}


def _ages(row: dict[str, Any], name: str) -> str:
    return " / ".join(f"{age:.0f}" for age in row[f"{name}_age_us"].values())


_LINES: Final[tuple[tuple[str, Callable[[dict[str, Any]], str]], ...]] = (
    ("samples", lambda row: str(row["samples"])),
    (
        "lost / repeated / decoded wrongly",
        lambda row: f"{row['lost']} / {row['repeated']} / {row['decoded_wrongly']}",
    ),
    ("age at TCP, µs (p50 / p99 / p99.9)", lambda row: _ages(row, "tcp")),
    ("age at the subscriber, µs", lambda row: _ages(row, "ros")),
    ("CPU, wrench / all topics, %", lambda row: f"{row['one']['cpu_percent']} / {row['all']['cpu_percent']}"),
    ("memory, MB (growth, kB)", lambda row: f"{row['all']['rss_mb']} ({row['all']['rss_growth_kb']})"),
)
