"""Watches one CPU for moments in which the machine stopped: wakes all the time and does nothing.

It runs at a higher priority than anything that is measured, pinned to its CPU, so nothing but the kernel or
the machine below it can keep it from waking. At the end it writes every interval between two wakes that is
longer than twice what it should be: pairs of CLOCK_MONOTONIC ns. No stop that long can escape it.
"""

from __future__ import annotations

import argparse
import os
import signal
import time
from array import array
from pathlib import Path

from scripts.benchmarks.records import began, steady, write


def main() -> None:
    """Watch until SIGTERM, then write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("path", type=Path)
    parser.add_argument("--cpu", type=int, required=True)
    parser.add_argument("--priority", type=int, default=0)
    parser.add_argument("--tick-us", type=float, required=True)
    arguments = parser.parse_args()
    stopping: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: stopping.append(number))
    os.sched_setaffinity(0, {arguments.cpu})
    steady(arguments.priority)
    pauses = array("q")
    monotonic_ns, sleep, tick_s = time.monotonic_ns, time.sleep, arguments.tick_us * 1e-6
    long_ns = int(2000 * arguments.tick_us)
    began(arguments.path).touch()
    woke = monotonic_ns()
    while not stopping:
        sleep(tick_s)
        now = monotonic_ns()
        if now - woke > long_ns:
            pauses.extend((woke, now))
        woke = now
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # Python takes 4 ms to end
    write(arguments.path, pauses)


if __name__ == "__main__":
    main()
