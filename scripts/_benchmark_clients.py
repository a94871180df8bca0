"""What eight clients, half of them odd, cost the acquisition against one: the server's lateness at waking.

Both are measured in turns on the same server, each for the ten seconds that `status` looks back.
"""

from __future__ import annotations

import contextlib
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

from rich.console import Console

from protocol.client import Client
from scripts._benchmark_chain import PORT, Chain, CpuUse, Setup, chain, start_server, virtual_bus
from scripts._demo import Child
from scripts._odd_clients import EIGHT

ONE: Final = ("honest",)
ROUNDS: Final = 3
_SETTLE_S: Final = 2.0
_WINDOW_S: Final = 10.5
"""What `last_10s` looks back, and some."""
_FIGURES: Final = ("wake_us", "exchange_us")
_POINTS: Final = ("p50", "p99", "p999", "max")


@contextlib.contextmanager
def clients(manners: Sequence[str]) -> Iterator[None]:
    """These clients, until the block ends."""
    with contextlib.ExitStack() as stack:
        for manner in manners:
            command = [sys.executable, "-m", "scripts._odd_clients", manner, str(PORT)]
            process = stack.enter_context(
                subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            if manner not in {"noise", "churn"}:
                process.stdout.readline()  # it has subscribed
            if manner == "stopped":
                process.send_signal(signal.SIGSTOP)
        yield


def measure(running: Chain, link: Client, server: Child, manners: Sequence[str]) -> dict[str, Any]:
    """The server's own figures with these clients."""
    with clients(manners):
        _wait(running, _SETTLE_S)
        before, use = link.ask("status"), CpuUse(running.watched["server"])
        _wait(running, _WINDOW_S)
        status, percent = link.ask("status"), use.percent()
    server.check()
    counters = ("cycles", "missed_deadlines", "lost_frames")
    lost = [sum(row["lost_samples"] for row in asked["sensors"]) for asked in (before, status)]
    return {
        **{name: status["last_10s"][name] for name in _FIGURES},
        **{name: status[name] - before[name] for name in counters},
        "lost_samples": lost[1] - lost[0],
        "cpu_percent": percent,
    }


def _wait(running: Chain, seconds: float) -> None:
    ending = time.monotonic() + seconds
    running.wait(lambda: time.monotonic() > ending, "", seconds + 5)


def ratio(one: Sequence[dict[str, Any]], eight: Sequence[dict[str, Any]]) -> float:
    """p99 of the lateness with eight clients over that with one, each the median of the rounds."""
    few, many = (statistics.median(float(row["wake_us"]["p99"]) for row in rows) for rows in (one, eight))
    return round(many / few, 2)


def measure_clients(setup: Setup, console: Console) -> dict[str, Any]:
    """Measure and print it. DemoError or Stopped end it early."""
    one: list[dict[str, Any]] = []
    eight: list[dict[str, Any]] = []
    with virtual_bus(setup) as (ifname, _), chain(setup) as running:
        link = start_server(running, ifname)
        server = running.children[-1]
        for _ in range(ROUNDS):
            for manners, rows, name in ((ONE, one, "one client"), (EIGHT, eight, "eight clients")):
                rows.append(measure(running, link, server, manners))
                console.print(f"{name:14} {_line(rows[-1])}", soft_wrap=True)
        link.close()
    result = {"one": one, "eight": eight, "wake_p99_ratio": ratio(one, eight)}
    console.print(f"late at waking, p99: eight clients / one = {result['wake_p99_ratio']}")
    return result


def _line(row: dict[str, Any]) -> str:
    texts = [
        f"{name.removesuffix('_us')} " + " / ".join(f"{row[name][point]:.0f}" for point in _POINTS) + " µs"
        for name in _FIGURES
    ]
    rest = f"{row['lost_samples']} lost, {row['cpu_percent']} % CPU"
    return f"{', '.join(texts)} (p50 / p99 / p99.9 / max); {rest}"
