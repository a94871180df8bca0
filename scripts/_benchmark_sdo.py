"""What 1,000 SDO reads and 50 tares a minute cost the stream: the same stream without and with them.

The sensor lies still, so that tares are accepted; every sample carries its number. Its instant follows from
that, because the sensor's clock is even: the youngest arrival of all says when number 0 came to be.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from ethercat_server.virtual_sensor.signals import REST_LENGTH
from protocol.client import Client
from protocol.errors import RefusedError
from scripts import _benchmark_statistics as statistics
from scripts._benchmark_chain import PORT, Chain, Setup, chain, recording, start_server, virtual_bus
from scripts._benchmark_records import COLUMNS, began
from scripts._benchmark_statistics import Arrivals, Ints
from scripts._demo import DemoError

SECONDS: Final = 60.0
"""Of each half, unless told otherwise."""
READS_PER_MINUTE: Final = 1000
TARES_PER_MINUTE: Final = 50
_TARE_S: Final = 0.25
"""Samples of a tare: so long twice."""
_OBJECTS: Final = ("Sampling rate", "Device name", "SINC length", "Fx offset", "Temperature")
"""Read in turns: some fit one answer, some do not."""


class Traffic(NamedTuple):
    """What was asked while one half was recorded."""

    reads: int
    tares: int
    refused: list[str]
    longest_read_ms: float
    worst_residual: float
    """N or Nm."""


def instants(number: Ints, received: Ints, period_ns: float) -> Ints:
    """When each sample came to be, but for one constant: the youngest is taken for of no age."""
    offset = float(np.min(received - number * period_ns))
    return np.asarray(np.round(number * period_ns + offset), dtype=np.int64)


def read_half(path: Path, period_ns: float) -> Arrivals:
    """The recording of a half. Its numbers are those of the signal `rest`."""
    (_, number, _, stamp, received) = statistics.read_numbers(path, COLUMNS).T
    steps = (np.diff(number) + REST_LENGTH // 2) % REST_LENGTH - REST_LENGTH // 2
    number = np.concatenate((number[:1], number[:1] + np.cumsum(steps)))
    return Arrivals(number, instants(number, received, period_ns), stamp, received)


def late(arrivals: Arrivals, period_ns: float, stopped: Ints) -> tuple[int, int]:
    """How many arrived more than a period older than the youngest, and how many of these in a stop."""
    ages = statistics.ages(arrivals)
    old = ages > period_ns
    met = np.zeros(len(ages), dtype=bool)
    for start, end in stopped:
        met |= (arrivals.instant < end) & (arrivals.received > start)
    return int(np.count_nonzero(old)), int(np.count_nonzero(old & met))


def judge(path: Path, setup: Setup, stopped: Ints) -> dict[str, Any]:
    """The figures of one half; `stopped` is when the machine did."""
    period_ns = setup.period_ns / (1 + setup.ppm * 1e-6)
    arrivals = read_half(path, period_ns)
    counts = statistics.count(arrivals, period_ns, stopped)
    too_late, late_in_stops = late(arrivals, period_ns, stopped)
    return {
        **vars(counts),
        "late": too_late,
        "late_in_stops": late_in_stops,
        "age_us": statistics.spread_us(statistics.ages(arrivals)),
    }


def ask(link: Client, running: Chain, seconds: float, samples: int) -> Traffic:
    """Reads and tares, evenly spread over `seconds`: a tare, then reads until the next is due."""
    tares = max(1, round(TARES_PER_MINUTE * seconds / 60))
    reads = max(1, round(READS_PER_MINUTE * seconds / 60))
    began = time.monotonic()
    refused: list[str] = []
    longest, worst, done = 0.0, 0.0, 0
    for tare in range(tares):
        try:
            answer = link.ask("tare", samples=samples)
            worst = max(worst, *(abs(value) for value in answer["residual"]))
        except RefusedError as error:
            refused.append(str(error))
        wanted = reads * (tare + 1) // tares
        ends = began + seconds * (tare + 1) / tares
        while done < wanted:
            running.check()
            asked = time.monotonic()
            try:
                link.ask("sdo_read", name=_OBJECTS[done % len(_OBJECTS)])
            except RefusedError as error:
                refused.append(str(error))
            longest = max(longest, time.monotonic() - asked)
            done += 1
            left = ends - time.monotonic()
            time.sleep(max(0.0, left / (wanted - done + 1)))
    return Traffic(done, tares, refused, round(longest * 1000, 1), worst)


def measure_sdo(setup: Setup, console: Console) -> dict[str, Any]:
    """Measure both halves and print them beside each other. DemoError or Stopped end it early."""
    setup = dataclasses.replace(setup, signal="rest")
    samples = round(_TARE_S * setup.rate_hz)
    with virtual_bus(setup) as (ifname, _), chain(setup) as running:
        start_server(running, ifname).close()
        running.start_canaries()
        without, _ = _half(running, "without", lambda: None)

        def traffic() -> Traffic:
            link = Client(PORT)
            with contextlib.closing(link):
                return ask(link, running, setup.seconds, samples)

        with_it, asked = _half(running, "with", traffic)
        running.stop()
        stopped = running.stops()
        halves = {
            "without": judge(without, setup, stopped),
            "with": judge(with_it, setup, stopped),
        }
    assert asked is not None
    _print(halves, asked, console)
    if asked.refused:
        raise DemoError(f"{len(asked.refused)} requests were refused, the first: {asked.refused[0]}")
    return {**halves, "traffic": asked._asdict()}


def _half(running: Chain, name: str, meanwhile: Callable[[], Traffic | None]) -> tuple[Path, Traffic | None]:
    """Record for the set time, doing something meanwhile: the recording, and what came of that."""
    path, arguments = recording(running, name)
    running.start_recorder(path, "scripts._benchmark_client", *arguments, "--port", PORT, "--signal", "rest")
    running.wait(lambda: began(path).exists() or path.exists(), "nothing was received")
    found = meanwhile()
    running.wait(path.exists, "the recording did not end", running.setup.seconds + 10)
    return path, found


_ROWS: Final[tuple[tuple[str, Callable[[dict[str, Any]], str]], ...]] = (
    ("samples made", lambda row: str(row["made"])),
    ("lost (of them in stops of the machine)", lambda row: f"{row['lost']} ({row['lost_in_stops']})"),
    ("repeated", lambda row: str(row["repeated"])),
    ("late by more than a period (in stops)", lambda row: f"{row['late']} ({row['late_in_stops']})"),
    (
        "age beyond the youngest, µs: p50 / p99",
        lambda row: f"{row['age_us']['p50']} / {row['age_us']['p99']}",
    ),
    ("age, µs, p99.9", lambda row: str(row["age_us"]["p999"])),
    ("age, µs, max", lambda row: str(row["age_us"]["max"])),
)


def _print(halves: dict[str, dict[str, Any]], asked: Traffic, console: Console) -> None:
    table = Table("", "without", "with", title=f"{asked.reads} SDO reads and {asked.tares} tares")
    for name, text in _ROWS:
        table.add_row(name, *(text(halves[half]) for half in ("without", "with")))
    console.print(table)
    console.print(
        f"longest SDO read {asked.longest_read_ms} ms, largest residual of a tare "
        f"{asked.worst_residual:.2g}, {len(asked.refused)} refused",
        soft_wrap=True,
    )
