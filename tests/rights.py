"""Other users, and programs with fewer rights than the tests: of whom this machine has them."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import importlib.util
import os
import pwd
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import pytest

# -- the user `nobody`

NOBODY = pwd.getpwnam("nobody")


def _why_no_other_user() -> str | None:
    """Why this process cannot become another user; None if it can."""
    if os.geteuid() != 0:
        return "it takes a second user id: run scripts/test as root"
    for line in Path("/proc/self/uid_map").read_text(encoding="ascii").splitlines():
        first, _, count = map(int, line.split())
        if first <= NOBODY.pw_uid < first + count:
            return None
    return "it takes a second user id: run scripts/test as root, or install uidmap and fill in /etc/subuid"


NO_OTHER_USER = _why_no_other_user()
needs_another_user: Final = pytest.mark.skipif(NO_OTHER_USER is not None, reason=NO_OTHER_USER or "")


@contextlib.contextmanager
def as_user(uid: int) -> Iterator[None]:
    """What is done within, root's process does as this user."""
    os.seteuid(uid)
    try:
        yield
    finally:
        os.seteuid(0)


def socket_of(uid: int | None, family: socket.AddressFamily = socket.AF_INET) -> socket.socket:
    """A TCP socket of this user: it belongs to whoever its maker was at that moment."""
    if uid is None or NO_OTHER_USER is not None:
        return socket.socket(family)
    with as_user(uid):
        return socket.socket(family)


# -- the server for other users, who may read neither the checkout nor the Python that runs it

_PACKAGES: Final = ("ethercat_server", "bota_ethercat", "pyroute2", "pysoem")
"""The server and all that it needs."""

PYTHON: Final = Path(sys.executable).resolve()
"""The one that the virtual environment was made with: the environment is a part of the checkout."""

_SHOW: Final = """
set -e
stage=$1 hidden=$2 shown=$3
shift 3
mount --bind "$shown" "$stage"
mount -t tmpfs -o mode=755 tmpfs "$hidden"
mkdir -p "$shown"
mount --bind "$stage" "$shown"
cd /
exec "$@"
"""
"""Shows a directory that lies in one which only root may enter, such as /root, to everybody: in a mount
namespace of its own, at its own path."""


def temporary() -> Path:
    """An empty directory that everybody may enter: pytest's, and perhaps TMPDIR, are its owner's only."""
    made = Path(tempfile.mkdtemp(prefix="ethercat-readable-", dir="/tmp"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    made.chmod(0o755)
    return made


@functools.cache
def copy() -> Path:
    """A directory with the server and what it needs, readable for everybody, as an installed one is."""
    made = temporary()
    for name in _PACKAGES:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        subprocess.run(["cp", "-a", Path(spec.origin).parent, made], check=True)
    subprocess.run(["chmod", "-R", "u=rwX,go=rX", made], check=True)
    return made


def python_prefix() -> Path:
    """The directory that Python and its library are in."""
    return Path(sys.base_prefix).resolve()


@functools.cache
def readable() -> tuple[str, ...]:
    """A command that becomes the one behind it, which finds the copy and may read Python as any user.

    What it starts is to be run with `PYTHON`.
    """
    shown = python_prefix()
    found = ("env", f"--chdir={copy()}", f"PYTHONPATH={copy()}", "PYTHONDONTWRITEBYTECODE=1")
    for hidden in reversed([shown, *shown.parents]):
        if not hidden.stat().st_mode & 0o001:  # the outermost that not everybody may enter
            paths = map(str, (temporary(), hidden, shown))
            return ("unshare", "--mount", "sh", "-c", _SHOW, "sh", *paths, *found)
    return found


def need(*command: str) -> None:
    """Skip where `readable` and `command`, such as `setpriv ...`, can start nothing at all."""
    tried = subprocess.run([*readable(), *command, "true"], check=False, capture_output=True, text=True)
    if tried.returncode:
        pytest.skip(NO_OTHER_USER or f"no other user can be started (run it as root): {tried.stderr.strip()}")


# -- the rights of a robot's user: no capabilities, only what limits grant

NET_ADMIN, NET_RAW, IPC_LOCK, SYS_NICE, SYS_RESOURCE = 12, 13, 14, 23, 24
"""Capabilities."""
_PR_CAPBSET_DROP: Final = 24
_SMALL_MEMORY: Final = 1 << 16


def _is_allowed(*statements: str) -> bool:
    """Tried in a process of its own: root in a container or a user namespace may not do everything."""
    code = "; ".join(("import os, resource", *statements))
    return (
        subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, check=False).returncode == 0
    )


needs_root: Final = pytest.mark.skipif(
    not _is_allowed("os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"),
    reason="needs root that may grant real-time scheduling (CAP_SYS_NICE)",
)
needs_limits: Final = pytest.mark.skipif(
    not _is_allowed(
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (30, 30))",
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))",
    ),
    reason="needs root that may raise limits (CAP_SYS_RESOURCE)",
)


def without(*capabilities: int) -> Callable[[], None]:
    """For `preexec_fn`: not even root has these."""
    libc = ctypes.CDLL(None)

    def drop() -> None:
        for capability in capabilities:
            libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)  # without root there is none to drop

    return drop


def limited(
    rt_priority: int = 0,
    memory: int = _SMALL_MEMORY,
    lacks: Sequence[int] = (IPC_LOCK, SYS_NICE, SYS_RESOURCE),
) -> Callable[[], None]:
    """For `preexec_fn`: limits (SCHED_FIFO priority, locked bytes), and which capabilities are missing."""
    drop = without(*lacks)

    def limit() -> None:
        drop()
        resource.setrlimit(resource.RLIMIT_RTPRIO, (rt_priority, rt_priority))
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (memory, memory))

    return limit


def skip_if_forbidden(text: str) -> None:
    """In a container even root, and a user's limits, may be worth nothing."""
    if "forbids it" in text:
        pytest.skip(f"no real-time scheduling here: {text}")
