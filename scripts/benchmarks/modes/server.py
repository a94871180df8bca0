"""The server under conditions: beside endless loops, behind slow network cards, for long."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from scripts.benchmarks.chain import PROCESSES, Chain, Figures, ScriptError, Setup
from scripts.benchmarks.modes.mode import Mode, losses, points
from scripts.benchmarks.statistics import Floats

REAL_TIME: Final = 40  # of the client, or of node and subscriber: the default of the node's `rt_priority`
_MOST_PERIODS: Final = 3.5  # longer round trips, in sample periods, are not measured
_SETTLE_S: Final = 2.0
_SETTLED: Final = 0.1  # the memory of this first part of the time does not count: caches still fill
_numbers: Final = itertools.count()  # the kernel removes an interface a moment after its process has ended


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


class Card(NamedTuple):
    """A network card; the round trip takes at most `jitter_us` more or less."""

    round_trip_ms: float
    jitter_us: float = 0.0

    def __str__(self) -> str:
        return f"{self.round_trip_ms:g} ms" + (f" ± {self.jitter_us:g} µs" if self.jitter_us else "")


# A relay stands for the card; the virtual bus alone, without it, has the first of them.
CARDS: Final = (Card(0.05), Card(0.44), Card(0.86), Card(2), Card(2, 200), Card(3), Card(3, 200))


def cards_for(rate_hz: float, round_trips_ms: Collection[float]) -> Iterator[Card]:
    """Those measured at this rate, of these round trips only if there are any."""
    for card in CARDS:
        wanted = not round_trips_ms or card.round_trip_ms in round_trips_ms
        if wanted and card.round_trip_ms * rate_hz / 1000 <= _MOST_PERIODS:
            yield card


def cards(setup: Setup, round_trips_ms: Collection[float]) -> list[Figures]:
    """A row for each card."""
    if setup.sensors != 1:
        raise ScriptError("--cards measures one sensor: leave out --sensors")
    rows = []
    for card in cards_for(setup.rate_hz, round_trips_ms):
        with Chain(setup, str(card)) as chain:
            chain.server(_attach(chain, card, chain.bus()))
            recorder = chain.recorder("tcp", warm_up_s=_SETTLE_S)
            figures, _ = chain.figures(recorder, chain.record(recorder))
        lost_percent = round(100 * figures["lost"] / figures["made"], 2)
        rows.append({"rate_hz": setup.rate_hz, "card": str(card), **figures, "lost_percent": lost_percent})
    return rows


def _attach(chain: Chain, card: Card, bus: str) -> str:
    """The interface of the card."""
    if card == CARDS[0]:
        return bus
    near, ready, priority = f"card{next(_numbers)}", chain.directory / "ready", chain.setup.priority
    delay_us = (card.round_trip_ms - CARDS[0].round_trip_ms) * 1000 / 2
    how = (delay_us, card.jitter_us / 2, min(99, priority + 2) if priority else 0)
    chain.python("relay", f"{PROCESSES}.relay", ready, near, bus, *how)
    chain.wait(ready.exists, "the relay did not start")
    return near


def _round_trips(text: str) -> list[float]:
    round_trips = [float(word) for word in text.split(",")]
    known = {card.round_trip_ms for card in CARDS}
    if not set(round_trips) <= known:
        raise argparse.ArgumentTypeError(f"must be among {', '.join(f'{each:g}' for each in sorted(known))}")
    return round_trips


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
CARD: Final = Mode(
    "only slow network cards, of these round trips (all)",
    cards,
    {
        "rate, round trip": lambda row: f"{row['rate_hz']} Hz, {row['card']}",
        "lost, %": lambda row: f"{row['lost_percent']:g}",
        "age p50, µs": lambda row: points(row["age_us"], "p50"),
        "stamp error p50 / p99, µs": lambda row: points(row["stamp_error_us"], "p50", "p99_absolute"),
    },
    argument={"type": _round_trips, "nargs": "?", "const": (), "metavar": "MS,..."},
    rates=(800, 1600),
    seconds=5.0,
    page=(0.05, 0.86, 2.0, 3.0),
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
