"""Programs with the rights of a robot's user: no capabilities, only what limits grant."""

from __future__ import annotations

import ctypes
import os
import resource
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pytest

IPC_LOCK, SYS_NICE, SYS_RESOURCE = 14, 23, 24
"""Capabilities."""
_PR_CAPBSET_DROP: Final = 24
_SMALL_MEMORY: Final = 1 << 16

needs_root: Final = pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to grant real-time scheduling")
needs_limits: Final = pytest.mark.skipif(
    not int(Path("/proc/self/status").read_text().partition("CapEff:")[2].split()[0], 16) >> SYS_RESOURCE & 1,
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
