"""Slow network cards: the server, and the same with one exchange at a time, at round trips of up to some
sample periods. A relay stands for the card; the virtual bus alone, without it, has the first of `CARDS`.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Collection, Iterator
from typing import Final, NamedTuple

from scripts.benchmarks.chain import PORT, PROCESSES, Chain, Figures, ScriptError, Setup
from scripts.benchmarks.modes.mode import Mode, points


class Card(NamedTuple):
    """A network card."""

    round_trip_ms: float
    jitter_us: float = 0.0
    """The round trip takes at most this more or less."""

    def __str__(self) -> str:
        return f"{self.round_trip_ms:g} ms" + (f" ± {self.jitter_us:g} µs" if self.jitter_us else "")


DIRECT: Final = Card(0.05)
CARDS: Final = (DIRECT, Card(0.44), Card(0.86), Card(2), Card(2, 200), Card(3), Card(3, 200))
SERVERS: Final = {"this": "ethercat_server.daemon.cli", "one at a time": f"{PROCESSES}.one_at_a_time"}
_MOST_PERIODS: Final = 3.5  # longer round trips, in sample periods, are not measured
_SETTLE_S: Final = 2.0
_numbers: Final = itertools.count()  # the kernel removes an interface a moment after its process has ended


def cards(rate_hz: float, round_trips_ms: Collection[float]) -> Iterator[Card]:
    """Those measured at this rate, of these round trips only if there are any."""
    for card in CARDS:
        wanted = not round_trips_ms or card.round_trip_ms in round_trips_ms
        if wanted and card.round_trip_ms * rate_hz / 1000 <= _MOST_PERIODS:
            yield card


def measure(setup: Setup, round_trips_ms: Collection[float]) -> list[Figures]:
    """A row for each card, with the figures of each server."""
    if setup.sensors != 1:
        raise ScriptError("--cards measures one sensor: leave out --sensors")
    return [
        {"rate_hz": setup.rate_hz, "card": str(card)}
        | {server: _measure_one(setup, card, server) for server in SERVERS}
        for card in cards(setup.rate_hz, round_trips_ms)
    ]


def _measure_one(setup: Setup, card: Card, server: str) -> Figures:
    with Chain(setup, f"{card}, {server}") as chain:
        chain.server(_attach(chain, card, chain.bus()), SERVERS[server]).close()
        recorder = chain.recorder("tcp", "--port", PORT, warm_up_s=_SETTLE_S)
        figures, _ = chain.figures(recorder, chain.record(recorder))
    return {**figures, "lost_percent": round(100 * figures["lost"] / figures["made"], 2)}


def _attach(chain: Chain, card: Card, bus: str) -> str:
    """The interface of the card."""
    if card == DIRECT:
        return bus
    near, ready, priority = f"card{next(_numbers)}", chain.directory / "ready", chain.setup.priority
    chain.python(
        "relay", f"{PROCESSES}.relay", ready, "--near", near, "--far", bus,
        "--delay-us", (card.round_trip_ms - DIRECT.round_trip_ms) * 1000 / 2,
        "--jitter-us", card.jitter_us / 2, "--priority", min(99, priority + 2) if priority else 0,
    )  # fmt: skip
    chain.wait(ready.exists, "the relay did not start")
    return near


def _round_trips(text: str) -> list[float]:
    round_trips = [float(word) for word in text.split(",")]
    known = {card.round_trip_ms for card in CARDS}
    if not set(round_trips) <= known:
        raise argparse.ArgumentTypeError(f"must be among {', '.join(f'{each:g}' for each in sorted(known))}")
    return round_trips


def _both(row: Figures, shown: Callable[[Figures], str]) -> str:
    this, other = (shown(row[server]) for server in SERVERS)
    return f"{this} ({other})"


MODE: Final = Mode(
    "only slow network cards, of these round trips (all)",
    measure,
    {
        "rate, round trip": lambda row: f"{row['rate_hz']} Hz, {row['card']}",
        "lost, % (one at a time)": lambda row: _both(row, lambda each: f"{each['lost_percent']:g}"),
        "age p50, µs": lambda row: _both(row, lambda each: points(each["age_us"], "p50")),
        "stamp error p50 / p99, µs": lambda row: points(row["this"]["stamp_error_us"], "p50", "p99_absolute"),
    },
    argument={"type": _round_trips, "nargs": "?", "const": (), "metavar": "MS,..."},
    rates=(800, 1600),
    seconds=5.0,
    page=(0.05, 0.86, 2.0, 3.0),
)
