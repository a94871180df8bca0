"""One configuration: everything side by side on the same virtual sensors.

This project and the bare C program take short turns, so that the machine's noise meets both.
"""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from scripts.benchmarks import chains, statistics
from scripts.benchmarks.chain import Setup, virtual_bus
from scripts.benchmarks.chains import Figures
from scripts.benchmarks.modes import vendor
from scripts.benchmarks.processes.yardstick import build
from scripts.benchmarks.results.plot import Curves
from scripts.benchmarks.statistics import Floats
from scripts.demonstration.child import DemoError

_MOST_TURNS: Final = 3
RATIOS: Final = {
    "age_p50": ("age_us", "p50"),
    "age_p99": ("age_us", "p99"),
    "age_p999": ("age_us", "p999"),
    "cpu": ("cpu_percent", "server"),
}
_SUMMED: Final = frozenset(
    (
        "made",
        "arrivals",
        "lost",
        "lost_in_stops",
        "repeated",
        "machine_stops",
        "missed_deadlines",
        "lost_frames",
    )
)

Turn = tuple[Figures, Floats]


@dataclass
class Progress:
    """Shows what is being measured."""

    console: Console
    total: int
    done: int = 0

    @contextlib.contextmanager
    def part(self, what: str) -> Iterator[None]:
        """One chain."""
        self.done += 1
        text = f"[{self.done}/{self.total}] {what}"
        if self.console.is_terminal:
            with self.console.status(text):
                yield
        else:
            print(text, flush=True)
            yield


@dataclass
class Compared:
    """What there is to compare with, and why something is not."""

    yardstick: Path | None = None
    """The built C program."""
    driver: bool = False
    ros: bool = False
    missing: dict[str, str] = field(default_factory=dict)

    @classmethod
    def find(cls, options: argparse.Namespace) -> Compared:
        """Build and look."""
        found = cls(ros=options.ros)
        try:
            found.yardstick = build(Path(os.environ["DEMO_DIRECTORY"]))
        except DemoError as error:
            found.missing["yardstick"] = str(error)
        if options.vendor and not (found := replace(found, driver=vendor.installed())).driver:
            found.missing["driver"] = f"{vendor.REQUIREMENT} could not be installed by scripts/benchmark"
        return found


def measure(setup: Setup, compared: Compared, progress: Progress) -> tuple[dict[str, Any], Curves]:
    """One configuration: everything side by side on the same virtual sensors."""
    name = f"{setup.rate_hz} Hz, {setup.sensors} sensor{'s' * (setup.sensors > 1)}"
    result: dict[str, Any] = {"rate_hz": setup.rate_hz, "sensors": setup.sensors, "missing": compared.missing}
    curves: Curves = {}

    def keep(program: str, way: str, measured: tuple[dict[str, Any], Floats]) -> None:
        (
            result.setdefault(program, {"tcp": None, "c": None, "ros": None})[way],
            curves[f"{program}, {way}"],
        ) = measured

    with virtual_bus(setup) as (ifname, sensor):
        run_by: list[Callable[[Setup], Turn]] = [lambda turn: chains.project_tcp(turn, ifname, sensor)]
        if program := compared.yardstick:
            run_by.append(lambda turn: chains.yardstick(turn, ifname, sensor, program))
            run_by.append(lambda turn: chains.project_tcp(turn, ifname, sensor, program))
        with progress.part(f"{name}: project{' and bare C' if program else ''}, TCP"):
            turns = in_turns(setup, run_by)
        keep("project", "tcp", together(turns[0]))
        if program:
            keep("yardstick", "tcp", together(turns[1]))
            keep("project", "c", together(turns[2]))
            result["yardstick"]["c"] = result["yardstick"]["tcp"]
            result["ratio"] = {"tcp": ratios(turns[0], turns[1]), "c": ratios(turns[2], turns[1])}
        one = setup.sensors == 1  # the others know one sensor only
        if compared.driver and one:
            with progress.part(f"{name}: Bota's driver"):
                keep("driver", "tcp", vendor.measure_driver(setup, ifname, sensor))
        if one:
            with progress.part(f"{name}: polling, TCP"):
                keep("polling", "tcp", chains.polling_tcp(setup, ifname, sensor))
        if compared.ros:
            with progress.part(f"{name}: project, ROS"):
                keep("project", "ros", chains.project_ros(setup, ifname, sensor))
        if compared.ros and one:
            with progress.part(f"{name}: polling, ROS"):
                keep("polling", "ros", chains.polling_ros(setup, ifname, sensor))
    return result, curves


def in_turns(setup: Setup, programs: Sequence[Callable[[Setup], Turn]]) -> list[list[Turn]]:
    """Each program's turns."""
    turns = max(1, min(_MOST_TURNS, int(setup.seconds)))
    short = replace(setup, seconds=setup.seconds / turns)
    rounds = [[program(short) for program in programs] for _ in range(turns)]
    return [list(each) for each in zip(*rounds, strict=True)]


def together(turns: Sequence[Turn]) -> Turn:
    """Counts are summed, ages pooled; of other figures it is the median, of the longest the longest."""
    ages = np.concatenate([each for _, each in turns])
    return {**_pool([figures for figures, _ in turns]), "age_us": statistics.spread_us(ages)}, ages


def _pool(values: Sequence[Any], name: str = "") -> Any:
    if isinstance(values[0], dict):
        return {key: _pool([value[key] for value in values], key) for key in values[0]}
    if not isinstance(values[0], int | float):
        return values[-1]
    if name in _SUMMED:
        return sum(values)
    if name == "max" or name.startswith("longest"):
        return max(values)
    return round(float(np.median(values)), 1)


def ratios(project: Sequence[Turn], yardstick: Sequence[Turn]) -> dict[str, dict[str, float]]:
    """This project by the C program: median, smallest and largest of the turns."""
    found = {}
    for name, (table, key) in RATIOS.items():
        pairs = zip(project, yardstick, strict=True)
        each = [ours[table][key] / theirs[table][key] for (ours, _), (theirs, _) in pairs]
        found[name] = {
            "median": round(float(np.median(each)), 2), "min": round(min(each), 2), "max": round(max(each), 2)
        }  # fmt: skip
    return found
