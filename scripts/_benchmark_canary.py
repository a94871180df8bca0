"""Watches one CPU for moments in which the machine stopped: wakes all the time and does nothing.

It runs at a higher priority than anything that is measured, pinned to its CPU, so nothing but the kernel or
the machine below it can keep it from waking. At the end it writes every interval between two wakes that is
longer than it should be: pairs of CLOCK_MONOTONIC ns.
"""

from __future__ import annotations

import argparse
import os
import signal
import time
from array import array
from pathlib import Path
from typing import Final

from scripts._benchmark_records import steady, write

TICK_NS: Final = 250_000
LONG_NS: Final = 2 * TICK_NS


def main() -> None:
    """Watch until SIGTERM, then write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("path", type=Path)
    parser.add_argument("--cpu", type=int, required=True)
    parser.add_argument("--priority", type=int, default=0)
    arguments = parser.parse_args()
    stopping: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopping.append(number))
    os.sched_setaffinity(0, {arguments.cpu})
    steady(arguments.priority)
    pauses = array("q")
    monotonic_ns, sleep, tick_s = time.monotonic_ns, time.sleep, TICK_NS * 1e-9
    woke = monotonic_ns()
    while not stopping:
        sleep(tick_s)
        now = monotonic_ns()
        if now - woke > LONG_NS:
            pauses.extend((woke, now))
        woke = now
    write(arguments.path, pauses)


if __name__ == "__main__":
    main()
