"""The benchmark's chain of processes: a virtual bus, its master, clients."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client import Client
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import SampleDecoder
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus
from scripts.benchmarks import statistics
from scripts.benchmarks.records import INPUT_BYTES, PORT, began, decode_clock
from scripts.benchmarks.statistics import Floats
from scripts.chain import Chain, Child

OVERSAMPLING_HZ: Final = 51200  # the sensor's rate is this over its SINC length
PROCESSES: Final = "scripts.benchmarks.processes"
PPM: Final = 150.0  # error of the sensors' clocks, with alternating sign, so that samples pass each other
WARM_UP_S: Final = 1.0  # from the first sample that a recorder has; the server's clocks are steady before
_TRIALS_S: Final = 3.0  # the server decides on event times, in up to five trials of half a second
_SETTLE_LIMIT_S: Final = 10.0  # measured is then, steady or not
Figures = dict[str, Any]
Turn = tuple[Figures, Floats]  # of one run, with all ages in ns


@dataclass(frozen=True)
class Setup:
    """What is measured, and for how long."""

    rate_hz: int
    sensors: int
    seconds: float
    priority: int  # SCHED_FIFO of the master; 0: ordinary scheduling
    ros: bool = True

    @property
    def sinc(self) -> int:
        return OVERSAMPLING_HZ // self.rate_hz


def used_s(pid: int) -> float:
    """CPU time of a process, s; finer than the ticks of `stat`."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[0]) for task in tasks) / 1e9


class MeasuredChain(Chain):
    """Virtual bus, master and clients of a setup."""

    def __init__(self, setup: Setup, title: str) -> None:
        """`title` is printed."""
        super().__init__()
        self.setup = setup
        self._settling: Figures = {}
        sensors = f"{setup.sensors} sensor{'s' * (setup.sensors > 1)}"
        print(f"{setup.rate_hz} Hz, {sensors}: {title}", file=sys.stderr, flush=True)

    def bus(self) -> str:
        """Start a virtual bus; its interface. The sensors have a CPU to themselves."""
        setup = self.setup
        errors = ",".join(str(PPM * (-1) ** position) for position in range(setup.sensors))
        arguments = f"--sensors {setup.sensors} --signal clock --sinc {setup.sinc} --ppm={errors}"
        bus = self.enter_context(VirtualBus(arguments, setup.priority))
        self.callback(self.stop)  # before the bus
        os.sched_setaffinity(bus.pid, own_cpus()[:1])
        return bus.ifname

    def server(self) -> Client:
        """Start ethercat-server on a bus; a connection to it once its sensors stream."""
        self.python(
            "server", "ethercat_server.daemon.cli", self.bus(), PORT,
            "--set", f"sinc_length={self.setup.sinc}",
            "--rt-priority", self.setup.priority, "--cpu", own_cpus()[1],
        )  # fmt: skip
        return self.connect(self.setup.sensors)

    def settle(self) -> None:
        """Wait until the server's clocks are steady; `measure` tells when, and what was lost until then."""
        assert self.link is not None
        decode, old = SampleDecoder(INPUT_BYTES).decode, DataFlag.REPEATED | DataFlag.INVALID
        numbers: list[list[int]] = [[] for _ in range(self.setup.sensors)]
        locked_since_s, uptime_s, is_steady = 0.0, 0.0, False
        with Client(PORT, raw=True, reconnect=False) as stream:
            while not is_steady and uptime_s < _SETTLE_LIMIT_S:
                self.sleep(0.05)
                while frames := stream.poll():
                    for frame in frames:
                        if not frame.flags & old:
                            clock = decode_clock(decode(frame.process_data).array)
                            numbers[frame.sensor].append(clock.number)
                status = self.link.ask("status")
                uptime_s, clocks = status["uptime_s"], [each["clock"] for each in status["sensors"]]
                if any(clock["mode"] != "locked" for clock in clocks):
                    locked_since_s = uptime_s
                is_steady = clocks_steady(clocks, uptime_s - locked_since_s)
        lost = sum(statistics.span(statistics.unwrap(each))[1] for each in numbers)
        self._settling = {"settled": {"seconds": round(uptime_s, 1)}, "lost_settling": lost}

    def master(self, c_program: Path) -> None:
        """Start the C program in place of the server, on its CPU."""
        setup = self.setup
        how = (self.bus(), setup.rate_hz, c_program, setup.priority)
        child = self.python("server", f"{PROCESSES}.masters", *how)
        os.sched_setaffinity(child.pid, own_cpus()[1:])

    def node(self, priority: int, position: int = 0) -> None:
        """Start the ROS 2 node of a sensor, with this priority; its `wrench` is /benchmark_POSITION."""
        given = f"server_port:={PORT}", f"sensor:={position}", f"rt_priority:={priority}"
        renamed = f"__node:=bridge_{position}", f"wrench:=/benchmark_{position}"
        words = [*(word for each in renamed for word in ("-r", each)), *(w for p in given for w in ("-p", p))]
        self.python(f"node {position}", "bota_ethercat_bridge.client", "--ros-args", *words)

    def recorder(
        self, kind: str, *arguments: object, priority: int = 0, warm_up_s: float = WARM_UP_S
    ) -> Child:
        """Start a recorder (processes/recorder.py, or of kind `c` the program given) that ends by itself."""
        times = (self.directory / kind, warm_up_s, self.setup.seconds)
        if kind == "c":
            return self.start(kind, *arguments, PORT, *times)
        return self.python(kind, f"{PROCESSES}.recorder", kind, *times, priority, *arguments)

    def measure(self, recorder: Child, beside: Callable[[], Child] | None = None) -> Turn:
        """Wait for a recording to be complete and end everything; what was recorded, and what it took.

        `beside` starts the recorder of a client at the same server when the recording begins.
        """
        path, seconds = recorder.result, self.setup.seconds
        self.wait(began(path).exists, "nothing was received")
        client = beside() if beside else None
        pid = next(child.pid for child in self.children if child.name == "server")
        start, before_s = time.monotonic(), used_s(pid)
        self.wait(lambda: time.monotonic() > start + seconds - 0.1 or path.exists(), seconds=seconds + 5)
        percent = 100 * (used_s(pid) - before_s) / (time.monotonic() - start)
        usage: Figures = {"cpu_percent": {"server": round(percent, 1)}}
        self.wait(path.exists, "the recording did not end")
        if client:
            self.wait(client.result.exists, "the client's recording did not end")
        if self.link:
            usage["hand_out_us"] = self.link.ask("status")["sensors"][0]["age_us"]
        self.stop()
        arrivals = statistics.read_arrivals(path)
        if client:
            usage |= statistics.lost_by_end(arrivals, statistics.read_arrivals(client.result))
        result, ages = statistics.summary(arrivals)
        return {**result, **usage, **self._settling}, ages


def clocks_steady(clocks: Sequence[Figures], locked_s: float) -> bool:
    """Whether the sensors' clocks in `status`, locked for this time, are steady.

    Event times on trial look like refused ones, so that polled stamps are decided only after all trials.
    """
    is_locked = all(clock["mode"] == "locked" for clock in clocks)
    return is_locked and (all(clock["stamps"] == "hardware" for clock in clocks) or locked_s >= _TRIALS_S)


def own_cpus() -> tuple[int, int]:
    """The CPU of the virtual sensors and that of their master: a real sensor takes no CPU time."""
    cpus = sorted(os.sched_getaffinity(0))
    return cpus[0], cpus[-1]
