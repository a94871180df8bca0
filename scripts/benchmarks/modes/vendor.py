"""Bota's closed Python driver (package bota-driver), on the same virtual sensor as the server.

The package is no dependency of the project. scripts/benchmark runs this module to install it into
.venv-vendor before the program enters its network namespace, from which no package index can be reached.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np

from scripts.benchmarks import statistics
from scripts.benchmarks.chain import PROCESSES, WARM_UP_S, Chain, Figures, ScriptError, Setup
from scripts.benchmarks.statistics import Arrivals, Floats

VERSION: Final = "1.1.16"
REQUIREMENT: Final = f"bota-driver=={VERSION}"
_ENVIRONMENT: Final = Path(__file__).parents[3] / ".venv-vendor"
_PYTHON: Final = _ENVIRONMENT / "bin" / "python"
# What the ROS packages in .venv set is not for another environment's Python.
_WITHOUT_ROS: Final = ("env", "-u", "LD_LIBRARY_PATH", "-u", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")


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
    """Make .venv-vendor. ScriptError if that fails."""
    print(f"installing {REQUIREMENT} into {_ENVIRONMENT} (once)", flush=True)
    pip = [sys.executable, "-m", "pip", "--python", str(_PYTHON), "install", "--quiet"]
    for command in (
        [sys.executable, "-m", "venv", "--clear", "--without-pip", str(_ENVIRONMENT)],
        [*pip, "--disable-pip-version-check", "--only-binary", ":all:", REQUIREMENT],
    ):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            why = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
            raise ScriptError(f"{REQUIREMENT} cannot be installed into {_ENVIRONMENT}: {why}")


def measure_driver(setup: Setup) -> tuple[Figures, Floats]:
    """The driver, with the server's priority, for which it does not ask; the ages of first returns."""
    with Chain(setup, "Bota's driver") as chain:
        path = chain.directory / "driver"
        driver = chain.start(
            "server", *_WITHOUT_ROS, _PYTHON, "-m", f"{PROCESSES}.vendor_driver", path,
            "--warm-up", WARM_UP_S, "--seconds", setup.seconds, "--ifname", chain.bus(),
            "--sinc", setup.sinc, "--calls", setup.rate_hz, "--priority", setup.priority, result=path,
        )  # fmt: skip
        figures, _ = chain.figures(driver, chain.record(driver))
        ages = first_ages(statistics.read_arrivals(path)[0])
    every = {"age_us": statistics.spread_us(ages), "every_age_us": figures["age_us"]}
    return {**figures, **every, "version": VERSION}, ages


def first_ages(arrivals: Arrivals) -> Floats:
    """How old each sample was when it arrived first, ns."""
    _, first = np.unique(arrivals.number, return_index=True)
    return statistics.ages(arrivals)[first]


def main() -> int:
    """Install the package if it is not there; returns the exit code, 0 also if it cannot be had."""
    try:
        if not installed():
            install()
    except ScriptError as error:
        print(f"benchmark: {error}", file=sys.stderr)
    except KeyboardInterrupt:  # the script says that it was stopped
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
