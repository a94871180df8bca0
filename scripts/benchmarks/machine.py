"""The machine's mode in a run: how late it wakes a process that only waits. By it two runs are compared."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import own_cpus

_SECONDS: Final = 2.0
_PERIOD_NS: Final = 1_250_000  # of a sensor at 800 Hz
_SLACK: Final = Path("/proc/self/timerslack_ns")


def wake_us(priority: int) -> dict[str, float]:
    """Lateness of a bare timer on the server's CPU with its scheduling: p50, p99, p999, us."""
    cpus, late = os.sched_getaffinity(0), []
    _SLACK.write_text("1000", encoding="ascii")
    try:
        os.sched_setaffinity(0, own_cpus()[1:])
        if priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        due = time.monotonic_ns()
        for _ in range(int(_SECONDS * 1e9 / _PERIOD_NS)):
            due = max(due + _PERIOD_NS, time.monotonic_ns())
            time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
            late.append(time.monotonic_ns() - due)
    finally:  # the processes that are measured do not inherit it
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, cpus)
        _SLACK.write_text("0", encoding="ascii")  # the default
    return statistics.spread_us(np.array(late, dtype=np.float64))


def sentence(wakes: Mapping[str, Mapping[str, float]]) -> str:
    """What was measured before and after everything else."""
    before, after = (
        f"{each['p50']:,.0f} µs (p99 {each['p99']:,.0f})" for each in (wakes["before"], wakes["after"])
    )
    return f"A bare timer woke {before} late before the measurements, {after} after them."
