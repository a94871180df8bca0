"""What a fresh sample is worth in contact: a simulated axis presses on a wall, by samples as old as measured.

The axis follows the commanded velocity with a lag; the controller commands, once a millisecond, a velocity
proportional to the force error of the newest sample. Samples pass through the virtual sensor's filters,
without noise. When each arrives, and which are lost, is as with the program that delivered samples in this
run; one that comes again changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from ethercat_server.virtual_sensor.filters import LoadFilter
from scripts.benchmarks import modes
from scripts.benchmarks.chain import OVERSAMPLING_HZ, Figures, Setup, Turn
from scripts.benchmarks.modes import BARE_C, DRIVER, THIS
from scripts.benchmarks.statistics import Floats

FORCE: Final = 10.0  # set point, N
GAIN: Final = 0.002  # m/s for each N of error
APPROACH: Final = 0.02  # m/s at most
LAG_S: Final = 0.002  # of the axis behind its command
CYCLE_S: Final = 0.001  # of the controller
GIVEN_WALL: Final = 100.0  # N/mm, of the overshoot and the picture
_STEP_S: Final = 0.0001  # of the simulation
_SECONDS: Final = 2.0  # from shortly before the contact
_AWAY: Final = 0.0005  # m from the wall at first
_STILL: Final = 1.0  # N: a force that moves less in the last quarter is stable
_WALLS: Final = (1.0, 3000.0)  # N/mm
_HALVINGS: Final = 9
FILTERS: Final[Mapping[str, tuple[int, bool]]] = {  # SINC length, FIR
    "SINC 64": (64, False),
    "SINC 32": (32, False),
    "SINC 64, FIR": (64, True),
}
IDEAL, POLLING = "no delay (computed)", "polling (computed)"
_DRAWN_S: Final = 0.1


class Delivery(NamedTuple):
    """How a program hands out samples."""

    ages_s: Floats  # of one sample after the other
    lost: float  # share of them

    @classmethod
    def of(cls, turn: Turn) -> Delivery:
        """As measured."""
        figures, ages_ns = turn
        return cls(ages_ns * 1e-9, figures["lost"] / figures["made"])


def computed(rate_hz: int) -> dict[str, Delivery]:
    """At once; and by a master that polls at the nominal rate a sensor whose clock passes its own."""
    return {IDEAL: Delivery(np.zeros(1), 0.0), POLLING: Delivery(np.linspace(0.0, 1.0 / rate_hz, 1000), 0.0)}


def press(wall: float, sinc: int, fir: bool, delivery: Delivery) -> Floats:
    """Force on a wall (N/mm), step by step, N."""
    stiffness, period_s = wall * 1e3, sinc / OVERSAMPLING_HZ
    forces = np.zeros(round(_SECONDS / _STEP_S))
    position, velocity, command, measured = -_AWAY, 0.0, APPROACH, 0.0
    sensor = LoadFilter(lambda t: (forces[max(0, int(t / _STEP_S))],), lambda: (0.0,), period_s, fir=fir)
    chance, ages_s = np.random.default_rng(1), delivery.ages_s
    arriving: list[tuple[float, float]] = []  # when, and the force
    number = count = 0
    per_cycle = round(CYCLE_S / _STEP_S)
    for step in range(len(forces)):
        now_s = step * _STEP_S
        while (number + 1) * period_s <= now_s:
            number += 1
            (force,) = sensor.at(number, number * period_s)
            if chance.random() >= delivery.lost:
                arriving.append((number * period_s + float(ages_s[number % len(ages_s)]), force))
        if step % per_cycle == 0:
            while count < len(arriving) and arriving[count][0] <= now_s:
                measured, count = arriving[count][1], count + 1
            command = min(APPROACH, max(-APPROACH, GAIN * (FORCE - measured)))
        velocity += (command - velocity) * _STEP_S / LAG_S
        position += velocity * _STEP_S
        forces[step] = max(0.0, position) * stiffness
    return forces


def overshoot(forces: Floats) -> float:
    """Above the set point, N."""
    return max(0.0, float(forces.max()) - FORCE)


def stiffest(sinc: int, fir: bool, delivery: Delivery) -> float:
    """The stiffest wall on which the contact is stable, N/mm."""
    low, high = map(math.log, _WALLS)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        end = press(math.exp(middle), sinc, fir, delivery)[-round(_SECONDS / _STEP_S / 4) :]
        if float(end.max() - end.min()) < _STILL and float(end.min()) > 0.0:
            low = middle
        else:
            high = middle
    return math.exp(low)


def measure(setup: Setup, with_driver: bool, picture: Path | None) -> list[Figures]:
    """A row for each program; the picture, if there is to be one."""
    missing = modes.find_missing(with_driver)
    names = [name for name in (THIS, BARE_C, DRIVER)[: 2 + with_driver] if name not in missing]
    delivered = {}
    for sinc in {sinc for sinc, _ in FILTERS.values()}:
        at = replace(setup, rate_hz=OVERSAMPLING_HZ // sinc)
        delivered[sinc] = {name: Delivery.of(modes.turn(at, name)) for name in names} | computed(at.rate_hz)
    if picture:
        draw(picture, {name: each for name, each in delivered[64].items() if name in (*names, IDEAL)})
    return [row(name, {sinc: each[name] for sinc, each in delivered.items()}) for name in delivered[64]]


def row(name: str, delivered: Mapping[int, Delivery]) -> Figures:
    """What comes of a program's samples, by SINC length."""
    made: Figures = {
        "program": name,
        "age_p50_us": float(np.median(delivered[64].ages_s)) * 1e6,
        "filters": {},
    }
    for which, (sinc, fir) in FILTERS.items():
        wall = stiffest(sinc, fir, delivered[sinc])
        above = overshoot(press(GIVEN_WALL, sinc, fir, delivered[sinc])) if wall > GIVEN_WALL else None
        made["filters"][which] = {"stiffest_wall": wall, "overshoot": above}
    return made


def answer(rows: list[Figures]) -> str:
    """The result in a sentence: what the driver is worth, and the filter."""
    walls = {each["program"]: {f: v["stiffest_wall"] for f, v in each["filters"].items()} for each in rows}
    than = DRIVER if DRIVER in walls else POLLING
    first, *_, last = FILTERS
    plain, filtered = (walls[THIS][which] / walls[than][which] for which in (first, last))
    return (
        f"**With {first} contact is stable on walls {plain:.1f} times as stiff as with {than}; with the FIR "
        f"filter on {filtered:.1f} times, and that filter costs a factor of "
        f"{walls[THIS][first] / walls[THIS][last]:.1f}.**"
    )


def _shown(which: str) -> Callable[[Figures], str]:
    def show(each: Figures) -> str:
        found = each["filters"][which]
        above = "unstable" if found["overshoot"] is None else f"{found['overshoot']:.1f}"
        return f"{found['stiffest_wall']:.0f} / {above}"

    return show


TABLE: Final[Mapping[str, Callable[[Figures], str]]] = {
    "": lambda each: each["program"],
    "age p50, µs": lambda each: f"{each['age_p50_us']:.0f}",
    **{which: _shown(which) for which in FILTERS},
}


def draw(path: Path, delivered: Mapping[str, Delivery]) -> None:
    """Force over time on the given wall, with SINC 64."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only for the page

    figure = Figure(figsize=(7, 3), layout="constrained")
    plot = figure.subplots()
    for name, delivery in delivered.items():
        forces = press(GIVEN_WALL, *FILTERS["SINC 64"], delivery)[: round(_DRAWN_S / _STEP_S)]
        plot.plot(1e3 * _STEP_S * np.arange(len(forces)), forces, label=name, linewidth=1)
    plot.set(xlabel="time, ms", ylabel=f"force on a wall of {GIVEN_WALL:.0f} N/mm, N")
    plot.legend()
    plot.grid(alpha=0.3)
    figure.savefig(path, dpi=90)
