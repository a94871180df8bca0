"""When this machine itself stopped: the benchmark's canaries, one on each CPU, beside the demo."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Final

from ethercat_server.process.realtime import DEFAULT_PRIORITY
from scripts.benchmarks import statistics
from scripts.benchmarks.records import began, may_be_real_time
from scripts.benchmarks.statistics import Ints
from scripts.demonstration.child import Child, DemoError

_START_TIMEOUT_S: Final = 30.0


class Canaries:
    """They run until `stop`, above everything else where real-time priority is granted."""

    def __init__(self, directory: Path, period_ns: float) -> None:
        """`period_ns` is the sensor's: a stop is what is longer."""
        self._period_ns = period_ns
        # The sensor has the priority above the server's.
        priority = min(99, DEFAULT_PRIORITY + 2) if may_be_real_time() else 0
        how = ("--priority", str(priority), "--tick-us", str(period_ns / 2000))
        self._running: list[tuple[Child, Path]] = []
        for cpu in sorted(os.sched_getaffinity(0)):
            path = directory / f"canary-{cpu}"
            module = "scripts.benchmarks.processes.canary"
            command = [sys.executable, "-m", module, str(path), "--cpu", str(cpu), *how]
            self._running.append((Child(path.name, command, directory), path))

    def wait(self) -> None:
        """Until all of them watch."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        for child, path in self._running:
            while not began(path).exists():
                child.check()
                if time.monotonic() > deadline:
                    raise DemoError(f"{child.name} did not begin within {_START_TIMEOUT_S:g} s")
                time.sleep(0.02)

    def stop(self) -> Ints:
        """End them; the stops of the machine, each with its beginning and end (CLOCK_MONOTONIC ns)."""
        for child, _ in self._running:
            child.stop()
        records = [statistics.read_numbers(path, 2) for _, path in self._running if path.exists()]
        self._running.clear()
        return statistics.stops(records, self._period_ns)
