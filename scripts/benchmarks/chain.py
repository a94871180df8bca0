"""Runs one chain of programs at a time on a virtual bus, with canaries beside it, and returns its figures."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil

from ethercat_server.virtual_sensor.virtual_bus import VirtualBus
from protocol.client import Client
from protocol.errors import ProtocolError
from scripts.benchmarks import statistics
from scripts.benchmarks.records import began
from scripts.benchmarks.statistics import Floats, Ints
from scripts.demonstration.child import Child, DemoError

PORT: Final = 12001
SERVER: Final = "ethercat_server.daemon.cli"
OVERSAMPLING_HZ: Final = 51200
"""The sensor's rate is this over its SINC length."""
_PATIENCE_S: Final = 30.0
_MEGABYTE: Final = 1e6


@dataclass(frozen=True)
class Setup:
    """What is measured, and for how long."""

    rate_hz: int
    sensors: int
    seconds: float
    warm_up_s: float
    priority: int
    ppm: float
    signal: str = "clock"
    step: Callable[[], None] = lambda: None
    """Called some times a second."""

    @property
    def period_ns(self) -> float:
        """Nominal sample period."""
        return 1e9 / self.rate_hz

    @property
    def sinc(self) -> int:
        """The SINC length that gives the rate."""
        return OVERSAMPLING_HZ // self.rate_hz

    @property
    def sensor_arguments(self) -> str:
        """The virtual sensors' clocks differ from nominal to opposite sides, so that they pass each other."""
        errors = ",".join(
            str(self.ppm if position % 2 == 0 else -self.ppm) for position in range(self.sensors)
        )
        return f"--sensors {self.sensors} --signal {self.signal} --sinc {self.sinc} --ppm={errors}"


def own_cpus() -> tuple[int, int]:
    """The CPU of the virtual sensors and that of their master: a real sensor takes no time of any."""
    cpus = sorted(os.sched_getaffinity(0))
    return cpus[0], cpus[-1]


class CpuUse:
    """What a process uses of one core from now on."""

    def __init__(self, process: psutil.Process) -> None:
        self._process = process
        self._began_s, self._had_s = time.monotonic(), self._used_s()

    def percent(self) -> float:
        """Since this was made."""
        return round(100 * (self._used_s() - self._had_s) / (time.monotonic() - self._began_s), 1)

    def _used_s(self) -> float:
        threads = Path(f"/proc/{self._process.pid}/task").glob("*/schedstat")
        if ran_ns := [int(thread.read_text().split()[0]) for thread in threads]:
            return sum(ran_ns) * 1e-9
        times = self._process.cpu_times()  # in whole ticks: coarse for a short turn
        return float(times.user + times.system)


@dataclass
class Chain:
    """A run of some programs: starts them, measures them, ends them."""

    setup: Setup
    directory: Path
    children: list[Child] = field(default_factory=list)
    canaries: list[Path] = field(default_factory=list)
    results: dict[Child, Path] = field(default_factory=dict)
    """Programs that may end by themselves, and the file that is there when they do."""
    watched: dict[str, psutil.Process] = field(default_factory=dict)

    def start(self, name: str, module: str, *arguments: object) -> Child:
        """Start a program of ours."""
        return self.start_command(name, sys.executable, "-m", module, *arguments)

    def start_command(self, name: str, *command: object) -> Child:
        """Start any program."""
        self.children.append(Child(name, list(map(str, command)), self.directory))
        return self.children[-1]

    def start_recorder(self, path: Path, module: str, *arguments: object) -> Child:
        """Start a program of ours that may end by itself once it has written `path`."""
        return self.start_command_recorder(path, sys.executable, "-m", module, *arguments)

    def start_command_recorder(self, path: Path, *command: object) -> Child:
        """Start any program that may end by itself once it has written `path`."""
        child = self.start_command(path.name, *command)
        self.results[child] = path
        return child

    def start_master(self, path: Path, module: str, *arguments: object) -> Child:
        """As `start_recorder`, for a program in the place of the server, on its CPU."""
        child = self.start_recorder(path, module, *arguments)
        os.sched_setaffinity(child.pid, own_cpus()[1:])
        self.watch("server", child.pid)
        return child

    def watch(self, name: str, pid: int) -> None:
        """Measure what this process takes."""
        self.watched[name] = psutil.Process(pid)

    def start_canaries(self) -> None:
        """One on each CPU, above everything else: the sensor has the priority above the server's.

        They wake twice a sample period.
        """
        priority = min(99, self.setup.priority + 2) if self.setup.priority else 0
        how = ("--priority", priority, "--tick-us", self.setup.period_ns / 2000)
        for cpu in sorted(os.sched_getaffinity(0)):
            path = self.directory / f"canary-{cpu}"
            self.start(f"canary-{cpu}", "scripts.benchmarks.processes.canary", path, "--cpu", cpu, *how)
            self.canaries.append(path)

    def check(self) -> None:
        """DemoError if a program failed."""
        self.setup.step()
        for child in self.children:
            try:
                child.check()
            except DemoError:
                if not (child in self.results and self.results[child].exists()):
                    raise

    def wait(self, done: Callable[[], bool], what: str, seconds: float = _PATIENCE_S) -> None:
        """Wait for something; DemoError if it does not come."""
        deadline = time.monotonic() + seconds
        while not done():
            self.check()
            if time.monotonic() > deadline:
                raise DemoError(f"{what} within {seconds:g} s")
            time.sleep(0.02)

    def record(self, path: Path) -> dict[str, Any]:
        """Wait for a recording, which has been started, to be whole; CPU and memory meanwhile."""
        self.wait(lambda: began(path).exists() or path.exists(), "nothing was received")
        uses = {name: CpuUse(process) for name, process in self.watched.items()}
        others, machine = cpu_of_others(), cpu_of_machine()
        started = time.monotonic()
        ending = started + self.setup.seconds - 0.1
        self.wait(lambda: time.monotonic() > ending or path.exists(), "", self.setup.seconds + 5)
        usage: dict[str, Any] = {"cpu_percent": {}, "rss_mb": {}}
        wall = time.monotonic() - started
        for name, process in self.watched.items():
            usage["cpu_percent"][name] = uses[name].percent()
            usage["rss_mb"][name] = round(process.memory_info().rss / _MEGABYTE, 1)
        since = sum(taken - others.get(pid, 0.0) for pid, taken in cpu_of_others().items())
        usage["cpu_percent"]["everything else"] = round(100 * since / wall, 1)
        usage["stolen_percent"] = stolen_percent(machine)
        self.wait(path.exists, "the recording did not end")
        return usage

    def stop(self) -> None:
        """End everything, the last first."""
        while self.children:
            self.children.pop().stop()

    def stops(self) -> Ints:
        """When the machine stopped; after `stop`."""
        pauses = [statistics.read_numbers(path, 2) for path in self.canaries]
        return statistics.stops(pauses, self.setup.period_ns)

    def figures(self, path: Path) -> tuple[dict[str, Any], Floats]:
        """What was recorded; after `stop`."""
        stopped = self.stops()
        result, ages = statistics.summary(statistics.read_arrivals(path), self.setup.period_ns, stopped)
        longest = float(np.max(stopped[:, 1] - stopped[:, 0])) / 1000 if len(stopped) else 0.0
        return {**result, "machine_stops": len(stopped), "longest_stop_us": round(longest, 1)}, ages


def cpu_of_others() -> dict[int, float]:
    """CPU seconds that each process outside this benchmark has taken so far."""
    me = psutil.Process()
    ours = {me.pid, *(child.pid for child in me.children(recursive=True))}
    taken = {}
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.pid not in ours:
                times = process.cpu_times()
                taken[process.pid] = times.user + times.system
    return taken


def cpu_of_machine() -> tuple[float, float]:
    """CPU seconds that a hypervisor has given to others, and all that have gone by."""
    times = psutil.cpu_times()
    return times.steal, sum(times) - times.guest - times.guest_nice


def stolen_percent(before: tuple[float, float]) -> float:
    """What a hypervisor took of all CPUs since then."""
    stolen, passed = (now - then for now, then in zip(cpu_of_machine(), before, strict=True))
    return round(100 * stolen / passed, 1) if passed else 0.0


@contextlib.contextmanager
def chain(setup: Setup) -> Iterator[Chain]:
    """A chain with its own directory, ended however the block ends."""
    directory = Path(tempfile.mkdtemp(dir=os.environ.get("DEMO_DIRECTORY")))
    running = Chain(setup, directory)
    try:
        yield running
    finally:
        running.stop()
        shutil.rmtree(directory, ignore_errors=True)


@contextlib.contextmanager
def virtual_bus(setup: Setup) -> Iterator[tuple[str, int]]:
    """A virtual bus: its interface, and the process of its sensors."""
    known = set(psutil.Process().children())
    with VirtualBus(setup.sensor_arguments, setup.priority) as bus:
        (sensor,) = set(psutil.Process().children()) - known
        os.sched_setaffinity(sensor.pid, own_cpus()[:1])
        yield bus.ifname, sensor.pid


def start_server(running: Chain, ifname: str, module: str = SERVER) -> Client:
    """ethercat-server, ready, and a connection to it."""
    setup = running.setup
    server = running.start(
        "server", module, ifname, PORT,
        "--set", f"sinc_length={setup.sinc}", "--rt-priority", setup.priority, "--cpu", own_cpus()[1],
    )  # fmt: skip
    running.watch("server", server.pid)
    clients: list[Client] = []

    def ready() -> bool:
        with contextlib.suppress(ProtocolError):
            clients.append(Client(PORT, stream=False, raw=True, reconnect=False).connect())
            return len(clients[-1].description["sensors"]) == setup.sensors
        return False

    running.wait(ready, "the server was not ready")
    for client in clients[:-1]:
        client.close()
    return clients[-1]


def recording(running: Chain, name: str) -> tuple[Path, tuple[str, ...]]:
    """A recording's path, and the arguments that tell a recorder of it."""
    path = running.directory / name
    times = ("--warm-up", str(running.setup.warm_up_s), "--seconds", str(running.setup.seconds))
    return path, (str(path), *times)
