"""The benchmark, started by scripts/benchmark in a network namespace of its own: arguments, order, files."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import struct
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from bota_ethercat.program.arguments import number
from scripts.benchmarks import machine, path
from scripts.benchmarks.chain import OVERSAMPLING_HZ, Figures, Setup
from scripts.benchmarks.modes import TABLES, answer, compare, load
from scripts.benchmarks.records import may_be_real_time
from scripts.chain import ScriptError, loopback_up, stoppable

_RATES_HZ: Final = [OVERSAMPLING_HZ // sinc for sinc in (32, 64, 128, 256, 512)]
_PRIORITY: Final = 80  # SCHED_FIFO of the server, or what is in its place
_LATENCY: Final = Path("/dev/cpu_dma_latency")
_BLOCK: Final = re.compile(r"(<!-- measured: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
_ON_PAGE: Final = ("comparison", "load")
_LOOPS_ON_PAGE: Final = 4


def run(options: argparse.Namespace, *, idle_states: bool) -> None:
    """Measure, show, write. ScriptError or Stopped end it early. `idle_states`: idle CPUs may halt."""
    loopback_up()
    if options.page:
        check(options.page)
    if idle_states:
        print("idle CPUs may halt (no access to /dev/cpu_dma_latency): samples are older than as root")
    priority, ros = _PRIORITY if may_be_real_time() else 0, find_spec("rclpy") is not None
    if not priority:
        print("no real-time scheduling here (CAP_SYS_NICE): everything runs with ordinary scheduling")
    if not ros:
        print("no ROS 2 here (rclpy): only up to a TCP client")
    wanted = dict.fromkeys((*_ON_PAGE, options.mode) if options.page else (options.mode,))
    began = time.monotonic()
    is_timed = list(wanted) != ["path"]
    before = machine.wake_us(priority) if is_timed else {}
    results = {name: measure(name, options, priority, ros=ros) for name in wanted}
    wake_us = {"before": before, "after": machine.wake_us(priority)} if is_timed else None
    for name, rows in results.items():
        print(f"\n{markdown(name, rows)}")
    if wake_us:
        print(f"\n{machine.sentence(wake_us)}")
    content = {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "kernel": platform.release(),
        "cpus": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "idle_states": idle_states,
        "rt_priority": priority,
        "wake_us": wake_us,
        **results,
    }
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    written = [options.json]
    if options.page:
        renew(options.page, content)
        written.append(options.page)
    print(f"{time.monotonic() - began:.0f} s; written: {', '.join(map(str, written))}")


def measure(name: str, options: argparse.Namespace, priority: int, *, ros: bool) -> list[Figures]:
    """The rows of a table, of all configurations."""
    seconds = options.seconds or (3.0 if options.quick else 4.5)
    if name == "path":
        return path.measure()
    whole = name == "comparison" and not options.quick
    rows = []
    for rate in options.rates or ((800, 1600) if whole else (800,)):
        for sensors in (1, 2) if whole else (1,):
            setup = Setup(rate, sensors, seconds, priority, ros)
            if name == "load":
                rows += load(setup, options.load or _LOOPS_ON_PAGE)
            else:
                rows += compare(setup, options.vendor)
    return rows


def markdown(name: str, rows: Sequence[Figures]) -> str:
    shown = TABLES[name].values()
    lines = [list(TABLES[name]), ["---"] * len(shown), *([show(row) for show in shown] for row in rows)]
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)


def check(path: Path) -> None:
    """ScriptError if the page has not one place for each part."""
    found = [match[2] for match in _BLOCK.finditer(path.read_text(encoding="utf-8"))]
    if sorted(found) != sorted(_ON_PAGE):
        names = ", ".join(_ON_PAGE)
        raise ScriptError(
            f"{path} must have <!-- measured: NAME --> and <!-- end --> once for each of {names}"
        )


def renew(path: Path, content: Mapping[str, Any]) -> None:
    """Put what was measured into the page, between the comments that name it."""
    check(path)
    where = (
        f"All figures on this page but those with another date are of one run: {content['date'][:10]}, "
        f"{content['cpus']} CPUs, Linux {content['kernel'].split('-')[0]}, Python {content['python']}, "
        f"{'with' if content['idle_states'] else 'without'} idle states. "
        f"{machine.sentence(content['wake_us'])}"
    )

    def measured(match: re.Match[str]) -> str:
        name = match[2]
        rows = content[name]
        if name == "comparison":  # the first and the last configuration: between them is nothing new
            by = [(row["rate_hz"], row["sensors"]) for row in rows]
            rows = [row for row, its in zip(rows, by, strict=True) if its in (by[0], by[-1])]
        text = markdown(name, rows)
        if name == "comparison":
            text = "\n\n".join((answer(content[name]), text, where))
        return f"{match[1]}{text}\n{match[3]}"

    path.write_text(_BLOCK.sub(measured, path.read_text(encoding="utf-8")), encoding="utf-8")


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """The command line; argparse exits with 2 for what is wrong with it."""
    parser = argparse.ArgumentParser(
        prog="scripts/benchmark",
        description="Measure this project beside a bare C program.",
    )
    parser.add_argument("--quick", action="store_true", help="one configuration only, in half a minute")
    parser.add_argument("--seconds", type=number(0.5, 3600), help="how long each chain is measured (4.5)")
    parser.add_argument("--json", type=Path, default="benchmark-results/benchmark.json", metavar="FILE",
                        help="where the figures go (%(default)s)")  # fmt: skip
    parser.add_argument("--page", type=Path, metavar="FILE.md",
                        help="measure all that this page has (docs/benchmark.md), and renew it")  # fmt: skip
    parser.add_argument("--vendor", action="store_true", help="Bota's own Python driver and KickCAT, too")
    parser.add_argument("--rates", type=int, nargs="+", choices=_RATES_HZ, metavar="HZ",
                        help="sample rates (800 1600)")  # fmt: skip
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--load", type=int, choices=range(1, 65), metavar="N",
                      help="only ages beside N endless loops, ordinary and real-time")  # fmt: skip
    only.add_argument("--path", action="store_true",
                      help="only a sample's source lines, calls and system calls in the server")  # fmt: skip
    options = parser.parse_args(argv)
    modes = {"load": options.load, "path": options.path, "comparison": True}
    options.mode = next(mode for mode, wanted in modes.items() if wanted)
    here = Path(os.environ.get("CALLED_FROM") or Path.cwd())
    options.json, options.page = here / options.json, options.page and here / options.page
    return options


def _benchmark() -> int:
    """Idle CPUs spin meanwhile, as with cyclictest, if that is allowed.

    A halted CPU takes tens of µs to wake, and in a virtual machine as long as the host is busy with others.
    """
    options, device = parse(), None
    with suppress(OSError):
        device = _LATENCY.open("wb", buffering=0)
    with device or nullcontext():
        if device:
            device.write(struct.pack("=i", 0))  # µs that a wake-up may take, until the file is closed
        run(options, idle_states=not device)
    return 0


def main() -> int:
    return stoppable(_benchmark, "benchmark", "stopped; nothing is written", 130)


if __name__ == "__main__":
    sys.exit(main())
