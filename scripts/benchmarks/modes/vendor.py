"""Bota's closed Python driver (package bota-driver) beside the server, on the same virtual sensor.

The package is no dependency of the project. scripts/benchmark runs this module to install it into
.venv-vendor before the program enters its network namespace, from which no package index can be reached.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import PORT, Chain, Setup, chain, recording, start_server, virtual_bus
from scripts.benchmarks.statistics import Arrivals, Floats
from scripts.demonstration.child import Child, DemoError

VERSION: Final = "1.1.16"
_REQUIREMENT: Final = f"bota-driver=={VERSION}"
_ROOT: Final = Path(__file__).parents[3]
_ENVIRONMENT: Final = _ROOT / ".venv-vendor"
_PYTHON: Final = _ENVIRONMENT / "bin" / "python"
_WITHOUT_ROS: Final = ("env", "-u", "LD_LIBRARY_PATH", "-u", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
"""What the ROS packages in .venv set is not for another environment's Python."""
_CLIENT: Final = "scripts.benchmarks.processes.client"
_DRIVER: Final = "scripts.benchmarks.processes.vendor_driver"


THIS: Final = {"this": False, "this, client SCHED_FIFO": True}


class Usage(NamedTuple):
    """A way to call the driver."""

    calls_per_sample: int
    real_time: bool
    """SCHED_FIFO with the server's priority; the driver does not ask for it by itself."""


USAGES: Final = {
    "driver": Usage(1, real_time=False),
    "driver, SCHED_FIFO": Usage(1, real_time=True),
    "driver, SCHED_FIFO, 4 calls a sample": Usage(4, real_time=True),
}


def installed() -> bool:
    """Whether .venv-vendor has the package in the version that is measured."""
    check = (
        f"import sys; from importlib.metadata import version; sys.exit(version('bota-driver') != '{VERSION}')"
    )
    try:
        return subprocess.run([_PYTHON, "-c", check], check=False, capture_output=True).returncode == 0
    except OSError:
        return False


def install() -> None:
    """Make .venv-vendor. DemoError if that fails."""
    print(f"installing {_REQUIREMENT} into {_ENVIRONMENT} (once)", flush=True)
    pip = [sys.executable, "-m", "pip", "--python", str(_PYTHON), "install", "--quiet"]
    for command in (
        [sys.executable, "-m", "venv", "--clear", "--without-pip", str(_ENVIRONMENT)],
        [*pip, "--disable-pip-version-check", "--only-binary", ":all:", _REQUIREMENT],
    ):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            why = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
            raise DemoError(f"{_REQUIREMENT} cannot be installed into {_ENVIRONMENT}: {why}")


def measure_this(setup: Setup, ifname: str, sensor: int, *, real_time: bool) -> dict[str, Any]:
    """The server, and a TCP client that has its priority or, as everywhere else here, has not."""
    with chain(setup) as running:
        running.start_canaries()
        running.watch("sensor", sensor)
        start_server(running, ifname).close()
        path, arguments = recording(running, "client")
        client = running.start_recorder(path, _CLIENT, *arguments, "--port", PORT)
        if real_time:
            os.sched_setscheduler(client.pid, os.SCHED_FIFO, os.sched_param(setup.priority))
        running.watch("client", client.pid)
        return _figures(running, path)


def measure_driver(setup: Setup, usage: Usage, ifname: str, sensor: int) -> dict[str, Any]:
    """One way to call the driver; its figures."""
    with chain(setup) as running:
        running.start_canaries()
        running.watch("sensor", sensor)
        path, arguments = recording(running, "driver")
        calls = usage.calls_per_sample * setup.rate_hz
        priority = setup.priority if usage.real_time else 0
        command = [
            *_WITHOUT_ROS, str(_PYTHON), "-m", _DRIVER, *arguments, "--ifname", ifname,
            "--sinc", str(setup.sinc), "--calls", str(calls), "--priority", str(priority),
        ]  # fmt: skip
        driver = Child("driver", command, running.directory)
        running.children.append(driver)
        running.results[driver] = path
        running.watch("driver", driver.pid)
        return {**usage._asdict(), **_figures(running, path)}


def _figures(running: Chain, path: Path) -> dict[str, Any]:
    taken = running.record(path)
    running.stop()
    figures, _ = running.figures(path)
    (arrivals,) = statistics.read_arrivals(path)
    return {**figures, "first_age_us": statistics.spread_us(first_ages(arrivals)), **taken}


def first_ages(arrivals: Arrivals) -> Floats:
    """How old each sample was when it arrived first, ns."""
    _, first = np.unique(arrivals.number, return_index=True)
    return statistics.ages(arrivals)[first]


def measure_vendor(setup: Setup, console: Console) -> dict[str, Any]:
    """Measure and print it. DemoError or Stopped end it early."""
    if setup.sensors != 1:
        raise DemoError("--vendor measures one sensor: leave out --sensors")
    if not installed():
        raise DemoError(
            f"{_REQUIREMENT} is not in {_ENVIRONMENT}: start this with scripts/benchmark --vendor"
        )
    result: dict[str, Any] = {"rate_hz": setup.rate_hz, "version": VERSION}
    with virtual_bus(setup) as (ifname, sensor):
        for name, real_time in THIS.items():
            if setup.priority or not real_time:
                result[name] = measure_this(setup, ifname, sensor, real_time=real_time)
        for name, usage in USAGES.items():
            if setup.priority or not usage.real_time:
                result[name] = measure_driver(setup, usage, ifname, sensor)
    console.print(table(result, setup.seconds))
    return result


def table(result: dict[str, Any], seconds: float) -> Table:
    """A column for each way that was measured."""
    columns = {name: rows(result[name], seconds) for name in (*THIS, *USAGES) if name in result}
    made = Table(title=f"{result['rate_hz']} Hz, bota-driver {result['version']}; ages p50 / p99")
    made.add_column("", no_wrap=True)
    for name in columns:
        made.add_column(name, justify="right")
    for title in columns["this"]:
        made.add_row(title, *(column[title] for column in columns.values()))
    return made


def rows(figures: dict[str, Any], seconds: float) -> dict[str, str]:
    """A column's cells by the name of the row."""
    cpu = figures["cpu_percent"]
    return {
        "samples made": str(figures["made"]),
        "lost (in stalls)": f"{figures['lost']} ({figures['lost_in_stops']})",
        "repeated": str(figures["repeated"]),
        "new samples, 1/s": f"{(figures['arrivals'] - figures['repeated']) / seconds:.1f}",
        "age, first return, µs": _points(figures["first_age_us"]),
        "age, every return, µs": _points(figures["age_us"]),
        "CPU, %": " + ".join(str(cpu[name]) for name in ("server", "client", "driver") if name in cpu),
        "CPU of all else, %": str(cpu["everything else"]),
    }


def _points(ages: dict[str, float]) -> str:
    return f"{ages['p50']:.0f} / {ages['p99']:.0f}"


def main() -> int:
    """Install the package if it is not there; returns the exit code."""
    try:
        if not installed():
            install()
    except DemoError as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # the script says that it was stopped
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
