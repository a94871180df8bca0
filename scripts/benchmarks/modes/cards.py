"""Slow network cards: the server, and the same with one exchange at a time, at round trips of up to some
sample periods. A relay stands for the card; the virtual bus alone, without it, has the first of `CARDS`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Collection, Iterator, Sequence
from typing import Any, Final, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table

from scripts.benchmarks.chain import PORT, SERVER, Chain, Setup, chain, recording, start_server, virtual_bus
from scripts.demonstration.child import DemoError


class Card(NamedTuple):
    """A network card."""

    round_trip_ms: float
    jitter_us: float = 0.0
    """The round trip takes at most this more or less."""

    def __str__(self) -> str:
        """What it is called."""
        return f"{self.round_trip_ms:g} ms" + (f" ± {self.jitter_us:g} µs" if self.jitter_us else "")


DIRECT: Final = Card(0.05)
CARDS: Final = (DIRECT, Card(0.44), Card(0.86), Card(2), Card(2, 200), Card(3), Card(3, 200))
SERVERS: Final = {"this": SERVER, "one at a time": "scripts.benchmarks.processes.one_at_a_time"}
SECONDS: Final = 5.0
QUICK_SECONDS: Final = 2.0
_MOST_PERIODS: Final = 3.5
"""Longer round trips, in sample periods, are not measured."""
_SETTLE_S: Final = 2.0
"""Before the client's own warm-up."""
_CLIENT: Final = "scripts.benchmarks.processes.client"
_RELAY: Final = "scripts.benchmarks.processes.relay"
_numbers: Final = itertools.count()
"""Of relays: the kernel removes an interface a moment after its process has ended."""


def cards(rate_hz: float, round_trips_ms: Collection[float]) -> Iterator[Card]:
    """Those measured at this rate, of these round trips only if there are any."""
    for card in CARDS:
        wanted = not round_trips_ms or card.round_trip_ms in round_trips_ms
        if wanted and card.round_trip_ms * rate_hz / 1000 <= _MOST_PERIODS:
            yield card


def measure_cards(
    setups: Sequence[Setup], round_trips_ms: Collection[float], console: Console
) -> list[dict[str, Any]]:
    """Measure and print them, a setup for each rate. DemoError or Stopped end it early."""
    if any(setup.sensors != 1 for setup in setups):
        raise DemoError("--cards measures one sensor: leave out --sensors")
    result: list[dict[str, Any]] = []
    for setup in setups:
        rows = []
        with virtual_bus(setup) as (bus, _):
            for card in cards(setup.rate_hz, round_trips_ms):
                for server, module in SERVERS.items():
                    print(f"{setup.rate_hz} Hz, {card}, {server}", flush=True)
                    about = {"rate_hz": setup.rate_hz, "card": card._asdict(), "server": server}
                    rows.append({**about, **measure_one(setup, card, bus, module)})
        console.print(table(rows, f"{setup.rate_hz} Hz, 1 virtual sensor; p50 / p99 in µs"))
        result += rows
    return result


def measure_one(setup: Setup, card: Card, bus: str, module: str) -> dict[str, Any]:
    """One server at one card."""
    with chain(setup) as running:
        running.start_canaries()
        link = start_server(running, attach(running, card, bus), module)
        settled = time.monotonic() + _SETTLE_S
        running.wait(lambda: time.monotonic() > settled, "")
        before = link.ask("status")
        path, arguments = recording(running, "client")
        running.start_recorder(path, _CLIENT, *arguments, "--port", PORT)
        usage = running.record(path)
        after = link.ask("status")
        link.close()
        running.stop()
        figures, _ = running.figures(path)
    return {**figures, **derived(figures, card, setup, before, after), **usage}


def attach(running: Chain, card: Card, bus: str) -> str:
    """The interface of the card."""
    if card == DIRECT:
        return bus
    number, priority = next(_numbers), running.setup.priority
    near, ready = f"card{number}", running.directory / f"relay-{number}"
    one_way_us = (card.round_trip_ms - DIRECT.round_trip_ms) * 1000 / 2
    relay = running.start(
        "relay", _RELAY, ready, "--near", near, "--far", bus, "--delay-us", one_way_us,
        "--jitter-us", card.jitter_us / 2, "--priority", min(99, priority + 2) if priority else 0,
    )  # fmt: skip
    running.wait(ready.exists, "the relay did not start")
    running.watch("relay", relay.pid)
    return near


def derived(
    figures: dict[str, Any], card: Card, setup: Setup, before: dict[str, Any], after: dict[str, Any]
) -> dict[str, Any]:
    """What follows from a recording and from two replies to `status`."""
    cycles, seconds = (after[name] - before[name] for name in ("cycles", "uptime_s"))
    return {
        "new_per_s": round((figures["arrivals"] - figures["repeated"]) / setup.seconds, 1),
        "lost_percent": round(100 * figures["lost"] / figures["made"], 2),
        "cycles_a_sample": round(cycles / seconds / setup.rate_hz, 2),
        "exchange_us": after["last_10s"]["exchange_us"],
        "age_by_best": round(figures["age_us"]["p50"] / (1000 * card.round_trip_ms / 2), 1),
    }


def table(rows: Sequence[dict[str, Any]], heading: str) -> Table:
    """A row for each server at each card."""
    made = Table(title=heading, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    made.collapse_padding = True
    for name in ("round trip", "server"):
        made.add_column(name, no_wrap=True)
    for name in ("new/s", "lost %", "repeated", "cycles/\nsample", "age", "age/\nbest", "stamp\nerror"):
        made.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        age, error = row["age_us"], row["stamp_error_us"]
        made.add_row(
            str(Card(**row["card"])),
            row["server"],
            f"{row['new_per_s']:.1f}",
            f"{row['lost_percent']:.2f}",
            str(row["repeated"]),
            f"{row['cycles_a_sample']:.2f}",
            f"{age['p50']:.0f} / {age['p99']:.0f}",
            f"{row['age_by_best']:.1f}",
            f"{error['p50']:.0f} / {error['p99_absolute']:.0f}",
        )
    return made
