"""The benchmark, started by scripts/benchmark in a network namespace of its own: arguments, order, files."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.console import Console

from ethercat_server.errors import ServerError
from scripts.benchmarks.chain import OVERSAMPLING_HZ, Setup, cpu_of_machine, stolen_percent
from scripts.benchmarks.comparison import Compared, Progress, measure
from scripts.benchmarks.idle_states import no_idle_states
from scripts.benchmarks.modes import cards
from scripts.benchmarks.modes.cpp import measure_cpp
from scripts.benchmarks.modes.load import measure_load
from scripts.benchmarks.modes.node import measure_node
from scripts.benchmarks.modes.path import measure_path
from scripts.benchmarks.modes.soak import soak
from scripts.benchmarks.records import may_be_real_time
from scripts.benchmarks.results.page import check, renew
from scripts.benchmarks.results.plot import draw
from scripts.benchmarks.results.report import print_configuration
from scripts.demonstration.child import DemoError
from scripts.demonstration.program import Stopped, ignore_signals, loopback_up, on_signal

MOST_CPUS: Final = 4
"""CPUs used: each of them runs a canary."""
_WIDTH: Final = 108
"""Minimum width of the tables."""
_SECONDS: Final = 6.0
_QUICK_SECONDS: Final = 3.0
_PAGE_LOOPS: Final = 4
_PAGE_CARDS: Final = (0.05, 0.86, 2.0, 3.0)
"""What the page has of `--load` and of `--cards`."""
_RATES: Final = tuple(OVERSAMPLING_HZ // sinc for sinc in (32, 64, 128, 256, 512))


class Mode(NamedTuple):
    """An option that measures one thing, by itself."""

    measure: Callable[[Setup, Console], dict[str, Any]]
    help: str
    seconds: float = _SECONDS
    """Default duration."""


def _compensation(setup: Setup, console: Console) -> dict[str, Any]:
    if find_spec("rclpy") is None:
        raise DemoError("no ROS 2 here (rclpy): install the extra 'ros' or source ROS 2")
    from scripts.benchmarks.modes.compensation import measure_compensation  # noqa: PLC0415 - needs ROS 2

    return measure_compensation(setup, console)


MODES: Final[dict[str, Mode]] = {
    "compensation": Mode(_compensation, "only what compensation costs the node for each sample"),
    "cpp": Mode(measure_cpp, "only the C++ client, against a bare read"),
    "path": Mode(measure_path, "only what a sample costs the server: source lines, calls, system calls"),
    "node": Mode(
        measure_node, "only the ROS 2 node: ages beside a TCP client, CPU, first message after a stop", 15.0
    ),
}


def _measure_one(
    options: argparse.Namespace, setup: Callable[[int, int], Setup], console: Console
) -> dict[str, Any]:
    """What an option measures by itself; empty without one."""
    one = setup(options.rates[0], options.sensors[0])
    if options.soak:
        return {"soak": soak(one, options.soak * 60, console)}
    if options.cards is not None:
        length = options.seconds or (cards.QUICK_SECONDS if options.quick else cards.SECONDS)
        setups = [replace(setup(rate, options.sensors[0]), seconds=length) for rate in options.rates]
        return {"seconds": length, "cards": cards.measure_cards(setups, options.cards, console)}
    if options.load:
        return {"load": measure_load(setup(options.rates[0], 1), options.load, options.ros, console)}
    for name, mode in MODES.items():
        if getattr(options, name):
            return {name: mode.measure(replace(one, seconds=options.seconds or mode.seconds), console)}
    return {}


def _measure_rest(
    options: argparse.Namespace, setup: Callable[[int, int], Setup], console: Console
) -> dict[str, Any]:
    """What the page has beside the comparison."""
    slow = [replace(setup(rate, 1), seconds=options.seconds or cards.SECONDS) for rate in options.rates]
    rest = {
        "load": measure_load(setup(options.rates[0], 1), _PAGE_LOOPS, options.ros, console),
        "cards": cards.measure_cards(slow, _PAGE_CARDS, console),
    }
    if options.ros:
        node = replace(setup(options.rates[0], 1), seconds=options.seconds or MODES["node"].seconds)
        rest["node"] = measure_node(node, console)
    return rest


def run(options: argparse.Namespace, console: Console, *, idle_states: bool) -> None:
    """Measure, show, write. DemoError or Stopped end it early.

    `idle_states`: idle CPUs may halt meanwhile.
    """
    loopback_up()
    if options.page:
        check(options.page)
    if idle_states:
        console.print(
            "idle CPUs may halt (no access to /dev/cpu_dma_latency): samples are older than as root"
        )
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:MOST_CPUS]))
    priority = options.rt_priority
    if priority and not may_be_real_time():
        console.print("no real-time scheduling here (CAP_SYS_NICE): everything runs with ordinary scheduling")
        priority = 0
    if options.ros and find_spec("rclpy") is None:
        console.print("no ROS 2 here (rclpy): only up to a TCP client")
        options.ros = False
    seconds = options.seconds or (_QUICK_SECONDS if options.quick else _SECONDS)

    def setup(rate: int, sensors: int) -> Setup:
        return Setup(rate, sensors, seconds, warm_up_s=1.0, priority=priority, ppm=options.ppm)

    if found := _measure_one(options, setup, console):
        write_json(options.json, options, priority, idle_states=idle_states, **found)
        print(f"written: {options.json}")
        return
    wanted = [setup(rate, sensors) for rate in options.rates for sensors in options.sensors]
    compared = Compared.find(options)
    alone, beside = 1 + compared.ros, 1 + compared.ros + compared.driver
    progress = Progress(console, sum(alone + beside * (one.sensors == 1) for one in wanted))
    began, machine = time.monotonic(), cpu_of_machine()
    results, curves = [], {}
    for one in wanted:
        result, curves[one.rate_hz, one.sensors] = measure(one, compared, progress)
        results.append(result)
    for result in results:
        print_configuration(result, console)
    rest = _measure_rest(options, setup, console) if options.page else {}
    stolen = stolen_percent(machine)
    content = write_json(
        options.json,
        options,
        priority,
        idle_states=idle_states,
        seconds=seconds,
        stolen_percent=stolen,
        configurations=results,
        **rest,
    )
    written = str(options.json)
    try:
        draw(curves, options.plot)
        written += f" and {options.plot}"
    except DemoError as error:
        console.print(str(error))
    if options.page:
        renew(options.page, content)
        written += f" and {options.page}"
    print(f"{time.monotonic() - began:.0f} s, of which a hypervisor took {stolen} %; written: {written}")


def write_json(path: Path, options: argparse.Namespace, priority: int, **results: Any) -> dict[str, Any]:
    """Everything that was measured, and where and how."""
    content = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": {
            "kernel": platform.release(),
            "machine": platform.machine(),
            "cpus_used": len(os.sched_getaffinity(0)),
            "python": platform.python_version(),
            "load_average": os.getloadavg(),
        },
        "rt_priority": priority,
        "ppm": options.ppm,
        **results,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return content


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """The command line; argparse exits with 2 for what is wrong with it."""
    parser = argparse.ArgumentParser(
        prog="scripts/benchmark",
        description="Measure this project beside a bare C program and a polling design.",
    )
    here = Path(os.environ.get("CALLED_FROM") or Path.cwd())
    folder = here / "benchmark-results"
    parser.add_argument("--quick", action="store_true", help="one configuration only, in half a minute")
    parser.add_argument("--seconds", type=_seconds, help=f"how long each chain is measured ({_SECONDS:g})")
    parser.add_argument("--json", type=Path, default=folder / "benchmark.json", metavar="FILE")
    parser.add_argument("--plot", type=Path, metavar="FILE.png")
    parser.add_argument("--page", type=Path, metavar="FILE.md",
                        help="measure all that this page has (docs/benchmark.md), and renew it")  # fmt: skip
    parser.add_argument("--vendor", action="store_true", help="Bota's own Python driver, too")
    parser.add_argument("--rates", type=_rates, metavar="HZ,...", help="sample rates (800,1600)")
    parser.add_argument("--sensors", type=_counts, metavar="N,...", help="sensors on the bus (1,2)")
    parser.add_argument("--ppm", type=float, default=150.0, help="the sensors' clock error (%(default)g)")
    parser.add_argument("--soak", type=float, metavar="MINUTES", help="only the server: losses, memory")
    for name, mode in MODES.items():
        parser.add_argument(f"--{name}", action="store_true", help=mode.help)
    parser.add_argument("--cards", type=_round_trips, nargs="?", const=(), metavar="MS,...",
                        help="only slow network cards, of these round trips (all)")  # fmt: skip
    parser.add_argument("--load", type=int, choices=range(1, 65), metavar="N",
                        help="only ages beside N endless loops, ordinary and real-time")  # fmt: skip
    parser.add_argument("--no-ros", dest="ros", action="store_false", help="TCP only")
    parser.add_argument("--rt-priority", type=int, choices=range(97), default=80, metavar="N",
                        help="SCHED_FIFO priority; 0 = ordinary scheduling (%(default)s)")  # fmt: skip
    options = parser.parse_args(argv)
    options.page = options.page and here / options.page
    plot = options.page.with_suffix(".png") if options.page else folder / "benchmark.png"
    options.json, options.plot = here / options.json, here / (options.plot or plot)
    only_one = options.quick or options.soak or options.load or any(getattr(options, name) for name in MODES)
    options.rates = options.rates or ([800] if only_one else [800, 1600])
    options.sensors = options.sensors or ([1] if only_one or options.cards is not None else [1, 2])
    return options


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.5 <= value <= 3600:
        raise argparse.ArgumentTypeError("must be from 0.5 to 3600")
    return value


def _rates(text: str) -> list[int]:
    rates = [int(word) for word in text.split(",")]
    if not set(rates) <= set(_RATES):
        raise argparse.ArgumentTypeError(f"rates must be among {', '.join(map(str, sorted(_RATES)))}")
    return rates


def _round_trips(text: str) -> list[float]:
    round_trips = [float(word) for word in text.split(",")]
    known = {card.round_trip_ms for card in cards.CARDS}
    if not set(round_trips) <= known:
        raise argparse.ArgumentTypeError(f"must be among {', '.join(f'{each:g}' for each in sorted(known))}")
    return round_trips


def _counts(text: str) -> list[int]:
    counts = [int(word) for word in text.split(",")]
    if not all(1 <= count <= 16 for count in counts):
        raise argparse.ArgumentTypeError("numbers of sensors must be from 1 to 16")
    return counts


def main() -> int:
    """Run; returns the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    directory = os.environ.get("DEMO_DIRECTORY")
    made = None if directory else tempfile.mkdtemp()
    os.environ["DEMO_DIRECTORY"] = directory or str(made)
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        options = parse()
        with no_idle_states() as held:
            run(options, Console(width=max(Console().width, _WIDTH)), idle_states=not held)
    except Stopped:
        print("stopped; nothing is written", file=sys.stderr)
        return 130
    except (DemoError, ServerError, OSError) as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 1
    finally:
        ignore_signals()
        shutil.rmtree(os.environ["DEMO_DIRECTORY"], ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
