"""The clients where there is no Linux, and on file systems that lack operations."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Final

from tests.clients.cpp_programs import GXX, needs_gxx
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


# What real file systems refuse: folders of VirtualBox, CIFS, WSL and 9P are not synced, some rename no open
# file, NFS and FUSE may lock nothing or count no links, and a folder may be busy when it is removed.
REFUSING: Final = r"""
#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
static int lacks(const char *call) {
    const char *given = strstr(getenv("LACKS"), call);
    return given ? atoi(given + strlen(call)) : 0;
}
static int refused(int code) { return code ? (errno = code, -1) : 0; }
#define REAL(call, ...) ((int (*)(__VA_ARGS__))dlsym(RTLD_NEXT, call))
extern "C" {
int fstat64(int fd, struct stat64 *found) noexcept {
    int code = REAL("fstat64", int, struct stat64 *)(fd, found);
    if (lacks("links")) found->st_nlink = 0;
    return code;
}
int fsync(int fd) {
    struct stat64 found;
    fstat64(fd, &found);
    return refused(lacks(S_ISDIR(found.st_mode) ? "folder" : "fsync"));
}
int flock(int, int) noexcept { return refused(lacks("flock")); }
int ftruncate64(int fd, off64_t size) noexcept {
    return refused(lacks("truncate")) ? -1 : REAL("ftruncate64", int, off64_t)(fd, size);
}
int rmdir(const char *path) noexcept {
    const char *name = strrchr(path, '/');
    if (name && !strncmp(name, "/.unfinished-", 13) && lacks("rmdir")) return refused(lacks("rmdir"));
    return REAL("rmdir", const char *)(path);
}
int rename(const char *from, const char *to) noexcept {
    char name[64], path[4096];
    for (int fd = 3; lacks("rename") && fd < 64; fd++) {
        snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
        ssize_t length = readlink(name, path, sizeof path);
        if (length > 0 && strlen(from) == (size_t)length && !memcmp(path, from, length))
            return refused(lacks("rename"));
    }
    return REAL("rename", const char *, const char *)(from, to);
}
}
"""
WRITERS: Final = """
from pathlib import Path
from bota_clients.export.cli import main as export
from bota_clients.identify.cli import main as identify
from bota_clients.record.recorder import Recorder
from bota_clients.report.cli import main as report
from bota_ethercat.program import tare_memory
for name in "a.csv", "a.npz", "a.mcap":
    assert export(["run.mcap", name]) == 0, name
assert export(["run.mcap", "a.zarr", "--fps", "30"]) == 0
assert report(["run.mcap", "-o", "a.html"]) in (0, 1)
assert identify(["tool.json", "--yaml", "a.yaml"]) == 0
with Recorder(Path("a.rec"), "test", {}, overwrite=False) as recorder:
    recorder.stop("")
assert not recorder.error, recorder.error
tare_memory.remember(1, [0] * 6, [1] * 6)
"""
TOOL: Final = """{"payload_compensator_config": {"payload_properties": {"mass": 1, "com": {"x": 0, "y": 0,
"z": 0.1}, "inertia": {"Ixx": 0, "Iyy": 0, "Izz": 0, "Ixy": 0, "Ixz": 0, "Iyz": 0}}}}"""


@needs_gxx
def test_a_file_that_is_there_and_complete_is_not_called_unwritten(tmp_path: Path) -> None:
    """Processes whose file system lacks an operation. A disk that is full is another matter."""
    (tmp_path / "refusing.cpp").write_text(REFUSING)
    library = tmp_path / "refusing.so"
    subprocess.run([str(GXX), "-shared", "-fPIC", "-o", library, library.with_suffix(".cpp")], check=True)
    for number, (folder_sync, sync, lock) in enumerate((
        (errno.EINVAL, errno.EINVAL, errno.EINVAL),
        (errno.ENOSYS, errno.ENOSYS, errno.ENOSYS),
        (errno.EACCES, errno.EOPNOTSUPP, errno.ENOLCK),
        (errno.EBADF, errno.ENOSPC, errno.EOPNOTSUPP),
    )):  # fmt: skip
        (folder := tmp_path / str(number)).mkdir()
        record(folder / "run.mcap", (frame(number) for number in range(400)))
        (folder / "tool.json").write_text(TOOL)
        lacks = f"folder {folder_sync} fsync {sync} flock {lock} truncate {sync} links 1 "
        lacks += f"rename {errno.ETXTBSY} rmdir {errno.EBUSY}"
        given = {"LD_PRELOAD": str(library), "LACKS": lacks, "STATE_DIRECTORY": "."}
        done = subprocess.run(
            [sys.executable, "-c", WRITERS], capture_output=True, text=True, check=False, timeout=60,
            env=os.environ | given, cwd=folder,
        )  # fmt: skip
        if sync == errno.ENOSPC:
            assert "a.csv cannot be written: No space left on device" in done.stderr
            continue
        assert done.returncode == 0, done.stderr
        made = ["a.csv", "a.html", "a.mcap", "a.npz", "a.rec", "a.yaml", "a.zarr", "tares.json"]
        assert {*made} <= {each.name for each in folder.iterdir()}
