"""One chain of processes, for the benchmark and the demo: a virtual bus, its master, clients."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final

from bota_ethercat.client import Client
from bota_ethercat.errors import ProtocolError
from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import SampleDecoder
from ethercat_server.errors import ServerError
from ethercat_server.ethercat.nic import change_flags
from ethercat_server.virtual_sensor.virtual_bus import VirtualBus
from scripts.benchmarks import statistics
from scripts.benchmarks.records import INPUT_BYTES, PORT, began, decode_clock
from scripts.benchmarks.statistics import Floats

OVERSAMPLING_HZ: Final = 51200  # the sensor's rate is this over its SINC length
PROCESSES: Final = "scripts.benchmarks.processes"
PPM: Final = 150.0  # error of the sensors' clocks, with alternating sign, so that samples pass each other
WARM_UP_S: Final = 1.0  # from the first sample that a recorder has; the server's clocks are steady before
_TRIALS_S: Final = 3.0  # the server decides on event times, in up to five trials of half a second
_SETTLE_LIMIT_S: Final = 10.0  # measured is then, steady or not
_START_TIMEOUT_S: Final = 30.0
_STOP_TIMEOUT_S: Final = 8.0
Figures = dict[str, Any]
Turn = tuple[Figures, Floats]  # of one run, with all ages in ns


class ScriptError(Exception):
    """The benchmark or the demo cannot go on; the text is one sentence."""


class Stopped(Exception):  # noqa: N818 - not an error
    """Ctrl-C or SIGTERM."""


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


class Child:
    """A program that never outlives this process; it may end by itself once `result` exists."""

    def __init__(self, name: str, command: list[str], directory: Path) -> None:
        self.name, self.result = name, directory / name
        self.log = directory / f"{name}.log"
        with self.log.open("wb") as log:
            # A session of its own: Ctrl-C reaches this process only, which then ends its children in order.
            self._process = subprocess.Popen(
                ["setpriv", "--pdeathsig", "SIGTERM", *command],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        self.pid = self._process.pid

    def check(self) -> None:
        """ScriptError, with its last lines of output, if it has failed."""
        code = self._process.poll()
        if code is not None and not self.result.exists():
            lines = self.log.read_text(errors="replace").strip().splitlines()[-8:]
            text = f"{self.name} ended by itself with exit code {code}; its last output:"
            raise ScriptError("\n    ".join([text, *lines]))

    def stop(self) -> str | None:
        """End it; what was wrong about how it ended, or None."""
        self._process.terminate()
        try:
            code = self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return f"{self.name} did not end at SIGTERM and was killed"
        return None if code == 0 else f"{self.name} ended with exit code {code}"


def used_s(pid: int) -> float:
    """CPU time of a process, s; finer than the ticks of `stat`."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[0]) for task in tasks) / 1e9


class Chain(contextlib.ExitStack):
    """A context in which programs run, and with which all of them end. `title` is printed."""

    def __init__(self, setup: Setup, title: str = "") -> None:
        super().__init__()
        self.setup = setup
        self.children: list[Child] = []
        self._link: Client | None = None
        self._settling: Figures = {}
        self.directory = Path(tempfile.mkdtemp(dir=os.environ.get("DEMO_DIRECTORY")))
        self.callback(shutil.rmtree, self.directory, ignore_errors=True)
        self.callback(self.stop)
        if title:
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

    def start(self, name: str, *command: object) -> Child:
        """Start any program; of the one named `server` `measure` has the CPU time."""
        child = Child(name, list(map(str, command)), self.directory)
        self.children.append(child)
        return child

    def python(self, name: str, module: str, *arguments: object) -> Child:
        return self.start(name, sys.executable, "-m", module, *arguments)

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
        assert self._link is not None
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
                status = self._link.ask("status")
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

    def connect(self, sensors: int) -> Client:
        """Connect as soon as the server describes this number of sensors; closed with the chain."""

        def ready() -> bool:
            with contextlib.suppress(ProtocolError):
                self._link = Client(PORT, stream=False, raw=True, reconnect=False).connect()
                self.callback(self._link.close)
                return len(self._link.description["sensors"]) == sensors
            return False

        self.wait(ready, "the server was not ready")
        assert self._link is not None
        return self._link

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

    def wait(self, done: Callable[[], bool], what: str = "a program did not get ready",
             seconds: float = _START_TIMEOUT_S) -> None:  # fmt: skip
        """Wait; ScriptError if a program fails or it takes too long."""
        deadline = time.monotonic() + seconds
        while not done():
            for child in self.children:
                child.check()
            if time.monotonic() > deadline:
                raise ScriptError(f"{what} within {seconds:g} s")
            time.sleep(0.02)

    def sleep(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > end, seconds=seconds + 5)

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
        if self._link:
            usage["hand_out_us"] = self._link.ask("status")["sensors"][0]["age_us"]
        self.stop()
        arrivals = statistics.read_arrivals(path)
        if client:
            usage |= statistics.lost_by_end(arrivals, statistics.read_arrivals(client.result))
        result, ages = statistics.summary(arrivals)
        return {**result, **usage, **self._settling}, ages

    def stop(self) -> list[str]:
        """End everything, the last first; what was wrong about how they ended."""
        troubles = [child.stop() for child in reversed(self.children)]
        self.children.clear()
        return [trouble for trouble in troubles if trouble]


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


def loopback_up() -> None:
    """Set the new namespace's loopback interface up, as `ip link set lo up` does."""
    change_flags(socket.if_nametoindex("lo"), on=1)  # IFF_UP


def stoppable(run: Callable[[], int], program: str, sentence: str, code: int) -> int:
    """Run a program, whose directory is removed however it ends; its exit code.

    If it is stopped, the sentence is said and the code returned.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _on_signal)
    os.environ.setdefault("DEMO_DIRECTORY", tempfile.mkdtemp())
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        return run()
    except Stopped:
        print(sentence, file=sys.stderr if code else sys.stdout)
        return code
    except BrokenPipeError:  # nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ScriptError, ServerError, OSError) as error:
        print(f"{program}: {error}", file=sys.stderr)
    finally:
        ignore_signals()
        shutil.rmtree(os.environ.pop("DEMO_DIRECTORY"), ignore_errors=True)
    return 1


def _on_signal(_number: int, _frame: FrameType | None) -> None:
    ignore_signals()  # the clean-up is not to be interrupted
    raise Stopped


def ignore_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
