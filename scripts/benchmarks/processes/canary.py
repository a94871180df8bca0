"""Watches one CPU for moments in which the machine stopped: wakes all the time and does nothing.

It runs at a higher priority than anything that is measured, pinned to its CPU, so nothing but the kernel or
the machine below it can keep it from waking. At SIGTERM it writes every interval between two wakes that is
longer than twice what it should be: pairs of CLOCK_MONOTONIC ns. No stop that long can escape it.

Arguments: FILE CPU PRIORITY TICK_US
"""

from __future__ import annotations

import os
import signal
import sys
import time
from array import array
from pathlib import Path

from scripts.benchmarks.records import began, steady, write

if __name__ == "__main__":
    path, tick_us, stopping = Path(sys.argv[1]), float(sys.argv[4]), list[int]()
    signal.signal(signal.SIGTERM, lambda number, _frame: stopping.append(number))
    os.sched_setaffinity(0, {int(sys.argv[2])})
    steady(int(sys.argv[3]))
    pauses = array("q")
    monotonic_ns, sleep, tick_s, long_ns = time.monotonic_ns, time.sleep, tick_us * 1e-6, int(2000 * tick_us)
    began(path).touch()
    woke = monotonic_ns()
    while not stopping:
        sleep(tick_s)
        now = monotonic_ns()
        if now - woke > long_ns:
            pauses.extend((woke, now))
        woke = now
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # Python takes 4 ms to end
    write(path, pauses)
