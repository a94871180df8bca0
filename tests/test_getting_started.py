"""docs/getting-started.md as someone without hardware follows it: its commands, in order."""

from __future__ import annotations

import contextlib
import csv
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.ros_package.test_workspace import clean_environment
from tests.server.running import ATTEMPTS, on_a_bus, starved, wait_until

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "getting-started.md").read_text()

ELSEWHERE = (
    "sudo apt", "sudo nmcli", "sudo systemctl", "systemctl", "sudo scripts/install-service",
    "source", "mkdir -p ~/ws", "sudo rosdep", "rosdep", "colcon", "ros2", "rviz2",
)  # fmt: skip
"""Commands that change the machine, need systemd, or ROS 2 from apt."""
JUDGES = ("ethercat-doctor", "ethercat-monitor")
"""Their exit code is a verdict, here on a machine that runs tests."""
NUMBER = re.compile(r"[-+±]?\d+(?:\.\d+)?")


class Step(NamedTuple):
    """What is typed, in which terminal ("": the one where commands end), and what appears."""

    typed: str
    terminal: str
    shown: list[str]


def steps() -> Iterator[Step]:
    """Those of the page's console blocks, in order."""
    for block in re.findall(r"^```console\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL):
        command = r"^([$>]) ((?:.*<<'END'\n(?:.*\n)*?END|(?:.*\\\n)*.*))\n((?:(?![$>] ).*\n)*)"
        for prompt, typed, shown in re.findall(command, block, re.MULTILINE):
            named = re.search(r"  # (\w+) terminal$", typed)
            terminal = "first" if prompt == ">" else named[1] if named else ""
            yield Step(typed, terminal, shown.splitlines())


def missing(shown: list[str], said: str) -> list[str]:
    """Lines of which `said` has none like it, in this order: the same words, with any numbers."""
    left, found = said.splitlines(), []
    for line in shown:
        words = [NUMBER.sub("\0", re.sub(r"/home/\w+", "", word)) for word in line.split() if word != "..."]
        like = re.compile(".*?".join(re.escape(word).replace("\0", NUMBER.pattern) for word in words))
        place = next((place for place, each in enumerate(left) if like.search(each)), None)
        if place is None:
            found.append(line)
        else:
            del left[: place + 1]
    return found


class Desk:
    """Terminals of one user, whose machine has no network but the loopback interface."""

    def __init__(self, folder: Path, checkout: Path, wheels: str) -> None:
        self.folder, self.checkout, self._count = folder, checkout, 0
        (folder / "bin").mkdir()
        sudo = folder / "bin" / "sudo"
        sudo.write_text('#!/bin/sh\nexec "$@"\n')
        sudo.chmod(0o755)
        environment = clean_environment() | {
            "HOME": str(folder), "PATH": f"{folder}/bin:{os.environ['PATH']}", "ROS_LOG_DIR": str(folder),
            "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": wheels, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        }  # fmt: skip
        for name in ("LD_LIBRARY_PATH", "BOTA_SERVER"):
            environment.pop(name, None)
        self._shell = subprocess.Popen(
            ["unshare", "--net", "bash"], stdin=subprocess.PIPE, cwd=checkout, env=environment, text=True,
            start_new_session=True,
        )  # fmt: skip
        self.run("ip link set lo up")

    def _send(self, text: str) -> None:
        assert self._shell.stdin is not None
        self._shell.stdin.write(text + "\n")
        self._shell.stdin.flush()

    def said(self, terminal: str) -> str:
        return (self.folder / f"{terminal}.out").read_text()

    def run(self, command: str) -> tuple[str, int]:
        """What a command that ends has said, and its exit code."""
        self._count += 1
        name, code = str(self._count), self.folder / f"{self._count}.code"
        os.mkfifo(code)
        self._send(f"{{ {command}\n}} >{self.folder}/{name}.out 2>&1; echo $? >{code}")
        ended = int(code.read_text())  # when it ends: installing takes minutes on a busy machine
        return self.said(name), ended

    def start(self, terminal: str, command: str) -> None:
        """One that goes on; again where a busy machine starved the virtual sensor."""
        keys = self.folder / terminal
        os.mkfifo(keys)
        (self.folder / f"{terminal}.out").touch()
        self._send(f"until {command.partition('  #')[0]}; do sleep 1; done <>{keys} >{keys}.out 2>&1 &")

    def type(self, terminal: str, line: str) -> None:
        self._send(f"echo {line} >{self.folder}/{terminal}")

    def close(self) -> None:
        assert self._shell.stdin is not None
        self._shell.stdin.close()
        os.killpg(self._shell.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._shell.wait(10)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._shell.pid, signal.SIGKILL)
        self._shell.wait()


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    if (wheels := os.environ.get("TEST_WHEELS")) is None:
        pytest.skip("pip needs packages to install: run scripts/test --long with a network")
    if sys.platform != "linux" or os.uname().machine != "x86_64":
        pytest.skip("ROS 2 from PyPI is for x86-64 only")
    ignored = shutil.ignore_patterns(".*", "build", "*.egg-info", "__pycache__")
    checkout = shutil.copytree(ROOT, tmp_path / "checkout", symlinks=True, ignore=ignored)
    made = Desk(tmp_path, checkout, wheels)
    try:
        yield made
    finally:
        made.close()


@pytest.mark.long
@pytest.mark.timeout(1200)
@on_a_bus
def test_who_follows_the_page_without_hardware_gets_a_wrench_without_tool_and_bias(desk: Desk) -> None:
    said = dict[str, str]()
    for typed, terminal, shown in steps():
        if typed.startswith(ELSEWHERE):
            continue
        if terminal:
            before = 0
            if typed.endswith("terminal"):
                desk.start(terminal, typed)
            else:
                before = len(desk.said(terminal))
                desk.type(terminal, typed)
            wait_until(lambda: not missing(shown, desk.said(terminal)[before:]), typed, 60)  # noqa: B023
            continue
        for _ in range(ATTEMPTS):
            said[typed], code = desk.run(typed)
            if not code or not (starved(said[typed]) or "is lost" in said[typed]):
                break
        assert code == 0 or any(name in typed for name in JUDGES), f"{typed}: {said[typed]}"
        assert not missing(shown, said[typed]), f"{typed}: {said[typed]}"

    with (desk.checkout / "push.csv").open(encoding="utf-8") as pushed:
        forces = [float(row["force_z_N"]) for row in csv.DictReader(pushed)]
    assert min(forces) < statistics.median(forces) - 4, "a push towards the robot is negative"
    (printed,) = [text for command, text in said.items() if "python - <<" in command]
    measured, compensated = (
        [float(value) for value in re.findall(rf"^{topic} (.*)$", printed, re.MULTILINE)[0].split()]
        for topic in ("wrench", "wrench_compensated")
    )
    assert max(map(abs, measured)) > 1.5
    assert max(map(abs, compensated)) < 1.0
