"""Programs with the rights of a robot's user: no capabilities, only what limits grant."""

from __future__ import annotations

import ctypes
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Final

import pytest

IPC_LOCK, SYS_NICE, SYS_RESOURCE = 14, 23, 24
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


def limited(
    rt_priority: int = 0,
    memory: int = _SMALL_MEMORY,
    without: Sequence[int] = (IPC_LOCK, SYS_NICE, SYS_RESOURCE),
) -> Callable[[], None]:
    """For `preexec_fn`: limits (SCHED_FIFO priority, locked bytes), and which capabilities are missing."""
    libc = ctypes.CDLL(None)

    def limit() -> None:
        for capability in without:
            libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)  # without root there is none to drop
        resource.setrlimit(resource.RLIMIT_RTPRIO, (rt_priority, rt_priority))
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (memory, memory))

    return limit


def skip_if_forbidden(text: str) -> None:
    """In a container even root, and a user's limits, may be worth nothing."""
    if "forbids it" in text:
        pytest.skip(f"no real-time scheduling here: {text}")
