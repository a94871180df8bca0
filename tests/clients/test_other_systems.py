"""The clients where there is no Linux: without its modules and what macOS or Windows lack of Python's own."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

from tests.clients.recordings import frame, record
from tests.server.running import free_port

ROOT: Final = Path(__file__).parents[2]
PROJECT: Final = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CLIENTS: Final = {
    name: entry for name, entry in PROJECT["scripts"].items() if entry.startswith("bota_clients.")
}

ELSEWHERE: Final = """
import importlib, sys, threading
# Python on Linux needs what Windows lacks, and so do some of the packages.
import asyncio, os, select, selectors, signal, socket, subprocess, tempfile, time
import mcap.writer, mcap.reader, numpy, rich.live, zstandard

missing = {
    os: "O_CLOEXEC O_DIRECTORY O_NONBLOCK chown fork geteuid getuid pread pwrite sched_setscheduler uname",
    select: "epoll poll",
    selectors: "DefaultSelector EpollSelector PollSelector",
    signal: "SIGHUP SIGKILL SIGUSR1 pthread_sigmask sigtimedwait",
    socket: "AF_NETLINK AF_PACKET AF_UNIX MSG_DONTWAIT TCP_KEEPIDLE SO_REUSEPORT",
    time: "CLOCK_MONOTONIC CLOCK_REALTIME clock_gettime",
}
for module, names in missing.items():
    for name in names.split():
        delattr(module, name)
for name in "fcntl grp pwd resource syslog termios pysoem pyroute2 rclpy".split():
    sys.modules[name] = None

for name, entry in CLIENTS.items():
    package, _, entry = entry.partition(":")
    sys.argv = [name, "--help"]
    try:
        getattr(importlib.import_module(package), entry)()
    except SystemExit as ended:
        assert ended.code == 0, name

import bota_clients.identify.program
from bota_clients.export import cli as export
from bota_clients.monitor import cli, program as monitoring
from bota_clients.program import Signals, call_on
from bota_clients.record import cli as record, program as recording
from bota_clients.replay import cli as replay, program as replaying
from bota_ethercat.client import connect

stop, recorder = Signals(), Signals()
where = "--server", f"localhost:{port}"
run = lambda: replaying.run(replay.parse_options([played, *where, "--loop"]), stop)
thread = threading.Thread(target=run, daemon=True)
thread.start()
while True:
    try:
        with connect(port, timeout_s=5.0) as sensor:
            assert next(iter(sensor)).force == (0, 0, 0)
            assert sensor.receive()
        break
    except Exception as error:
        assert "refused" in str(error), error
assert recording.run(record.parse_options([recorded, *where, "--seconds", "0.2"]), recorder) == 0
monitoring._ONCE_S = 0.1
assert monitoring.run(cli.parse(["--once", *where])) in (0, 1)
stop._on_signal(0, None)
thread.join()
assert export.main([recorded, table]) == 0

class Loop:
    def add_signal_handler(self, number, stop):
        raise NotImplementedError
call_on(Loop(), print, "SIGINT", "SIGHUP")
"""


def test_they_run_without_linux(tmp_path: Path) -> None:
    """A process, in which all that is missing."""
    played, recorded, table = (str(tmp_path / name) for name in ("played.mcap", "recorded.mcap", "table.csv"))
    record(tmp_path / "played.mcap", (frame(number, **{"force.x": 0}) for number in range(400)))
    port = free_port()
    given = f"CLIENTS, port = {CLIENTS!r}, {port}\n"
    given += f"played, recorded, table = {played!r}, {recorded!r}, {table!r}\n"
    done = subprocess.run(
        [sys.executable, "-c", given + ELSEWHERE], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    for name in CLIENTS:
        assert f"usage: {name}" in done.stdout
    assert len(Path(table).read_text().splitlines()) > 50


def test_only_linux_gets_what_the_server_needs() -> None:
    assert all(line.endswith("; sys_platform == 'linux'") for line in PROJECT["dependencies"])
