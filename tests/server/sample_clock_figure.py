"""Draws docs/sample-clock.svg: how the phase is found and held, and what slow network cards cost.

usage: python -m tests.server.sample_clock_figure [OUT.svg]. Everything is simulated.
"""

from __future__ import annotations

import math
import sys
from bisect import bisect
from collections.abc import Iterable, Sequence
from copy import copy
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

from tests.clock_simulation import SECOND, Card, ClockSimulation, Machine, Sensor

FIGURE: Final = Path(__file__).parents[2] / "docs" / "sample-clock.svg"
RATES_HZ: Final = (800.0, 1600.0)
ROUND_TRIPS_NS: Final = [40e3 * 10 ** (each / 10) for each in range(21)]
STOP_S: Final = 0.5
STOP_LENGTH_S: Final = 0.7
_END_S: Final = 2.0
_STEPS: Final = 200  # points in a second


class Phase(NamedTuple):
    """At some time: how far the estimate is off, and its standard deviation, µs."""

    time_s: float
    error_us: float
    deviation_us: float


class Cost(NamedTuple):
    """What a network card costs at a rate, with a round trip in µs: ages, and the part of samples lost."""

    rate_hz: float
    round_trip_us: float
    median_us: float
    p99_us: float
    lost: float


def phases() -> list[Phase]:
    """At 1600 Hz, with a stop of the machine."""
    stops = ((STOP_S, STOP_LENGTH_S * SECOND),)
    simulation = ClockSimulation(Sensor(), Card(), Machine(stops=stops), seed=1)
    estimates = []
    for step in range(1, int(_END_S * _STEPS)):
        time_s = step / _STEPS
        if not STOP_S <= time_s < STOP_S + STOP_LENGTH_S:
            simulation.run(time_s)
        estimate = copy(simulation.clock.estimate)
        # Nothing is observed in the stop: the estimate is carried on, as it is when the machine is back.
        estimate.advance(max(0, math.ceil((time_s * SECOND - estimate.phase_ns) / estimate.period_ns)))
        phase_ns = estimate.phase_ns + simulation.timing.least_ns / 2
        estimates.append((time_s, phase_ns, math.sqrt(estimate.variance)))
    instants, found = simulation.run(_END_S + 0.01).instants_ns, []
    for time_s, phase_ns, deviation_ns in estimates:
        after = bisect(instants, phase_ns)
        error_ns = min((phase_ns - instants[each] for each in (after - 1, after)), key=abs)
        found.append(Phase(time_s, error_ns / 1e3, deviation_ns / 1e3))
    return found


def costs(round_trips_ns: Iterable[float]) -> list[Cost]:
    """Of cards whose round trip varies by 5 %."""
    found = []
    for rate_hz, round_trip_ns in product(RATES_HZ, round_trips_ns):
        card = Card(round_trip_ns, spread=0, jitter_ns=0.1 * round_trip_ns)
        shown = ClockSimulation(Sensor(rate_hz), card, Machine(), seed=1).run(8).outcome(2)
        count, ages_us = len(shown.samples), [age_ns / 1e3 for age_ns in shown.ages_ns]
        middle, p99 = ages_us[count // 2], ages_us[count * 99 // 100]
        found.append(Cost(rate_hz, 1.05 * round_trip_ns / 1e3, middle, p99, shown.lost / count))
    return found


def draw(path: Path, held: Sequence[Phase], cost: Sequence[Cost]) -> None:
    """Write the figure."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams["svg.fonttype"] = "none"
    mpl.rcParams["svg.hashsalt"] = "sample-clock"  # the same file every time
    figure = Figure(figsize=(12, 4))
    phase, age = figure.subplots(1, 2)
    times, errors, deviations = zip(*held, strict=True)
    for sign, label in ((-2, None), (2, "± 2 standard deviations")):
        edge = [sign * each for each in deviations]
        phase.plot(times, edge, color="tab:blue", linewidth=0.8, label=label)
    phase.plot(times, errors, color="tab:red", linewidth=0.8, label="error")
    phase.axvspan(STOP_S, STOP_S + STOP_LENGTH_S, color="0.9", zorder=0)
    phase.set(xlabel="s", ylabel="phase, µs", ylim=(-25, 25))
    phase.set_title("Lock at 1600 Hz, and holdover while the machine stands still (grey)", fontsize=10)
    phase.legend(fontsize=8)
    share = age.twinx()
    for rate_hz, color in zip(RATES_HZ, ("tab:blue", "tab:red"), strict=True):
        mine = [each for each in cost if each.rate_hz == rate_hz]
        _, trips, median, p99, lost = zip(*mine, strict=True)
        age.plot(trips, median, color=color, label=f"{rate_hz:.0f} Hz, median")
        age.plot(trips, p99, color=color, linestyle="--", label=f"{rate_hz:.0f} Hz, p99")
        percent, label = [100 * each for each in lost], f"{rate_hz:.0f} Hz, lost"
        share.plot(trips, percent, color=color, linestyle="none", marker=".", label=label)
    age.plot(trips, [trip / 2 for trip in trips], color="0.5", linestyle=":", label="half a round trip")
    age.set(xlabel="round trip ± 5 %, µs", ylabel="age, µs", xscale="log", yscale="log")
    share.set(ylabel="lost, % (dots)", ylim=(-0.02, 1))
    age.set_title("Age and losses against the round trip", fontsize=10)
    age.legend(fontsize=8)
    for panel in (phase, age):
        panel.grid(visible=True, color="0.93")
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FIGURE, phases(), costs(ROUND_TRIPS_NS))
