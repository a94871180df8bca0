"""A veth pair and a virtual sensor process on one end of it, always cleared away."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
_numbers = itertools.count()


def _ip(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["ip", *words], capture_output=True, text=True, check=False)


@pytest.fixture
def veth() -> Iterator[tuple[str, str]]:
    """Names of the two ends, both up: the sensor's, the master's."""
    number = next(_numbers) % 100
    sensor_end, master_end = (f"vs{side}{os.getpid() % 10**7}x{number}" for side in "ab")
    try:
        made = _ip("link", "add", sensor_end, "type", "veth", "peer", "name", master_end)
    except FileNotFoundError:
        pytest.skip("no `ip` command: install iproute2")
    if made.returncode != 0:
        pytest.skip(f"no veth pair can be made here: {made.stderr.strip()}")
    try:
        for name in (sensor_end, master_end):
            assert _ip("link", "set", name, "up").returncode == 0
        yield sensor_end, master_end
    finally:
        _ip("link", "del", sensor_end)


class SensorProcess:
    """A running `ethercat-virtual-sensor`; commands go to its stdin."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ethercat_server.virtual_sensor", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        self.ready = self.line()

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().rstrip("\n")

    def command(self, text: str) -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()
        return self.line()

    def end(self) -> tuple[int, str]:
        """Exit code and what is left on stderr; asked again, the exit code."""
        if self.process.stdout is not None and self.process.stdout.closed:
            return self.process.returncode, ""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        if self.process.stdin is not None and self.process.stdin.closed:
            self.process.stdin = None
        _, errors = self.process.communicate(timeout=30)
        return self.process.returncode, errors


@pytest.fixture
def start() -> Iterator[Callable[..., SensorProcess]]:
    """Starts virtual sensors; ends those that are left."""
    running: list[SensorProcess] = []

    def launch(*arguments: str) -> SensorProcess:
        running.append(SensorProcess(*arguments))
        return running[-1]

    yield launch
    for each in running:
        each.end()
