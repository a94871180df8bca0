# SPDX-License-Identifier: Apache-2.0
"""Real-time scheduling: SCHED_FIFO and a CPU for one thread, memory that is never paged out.

Beside programs that use every CPU, an ordinary client has its samples some milliseconds late. Each right is
used if the system allows it; what is not allowed is said, with what would allow it (docs/tuning.md).
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from typing import Final, NamedTuple

HIGHEST_PRIORITY: Final = 98  # 99 is the kernel's own threads'
# MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT: pages stay in memory once they have been used.
_MLOCK: Final = 1 | 2 | 4
_CAP_IPC_LOCK: Final = 14
_LIMITS: Final = "a file in /etc/security/limits.d"


class Scheduling(NamedTuple):
    """What a thread was given. As text it is one phrase."""

    priority: int = 0  # of SCHED_FIFO; 0: its scheduling is as it was
    cpu: int | None = None  # the CPU that it is pinned to
    memory_locked: bool = False
    refused: tuple[str, ...] = ()  # what was not granted, each with what would grant it

    def __str__(self) -> str:
        """What was granted, then what was not."""
        granted = [f"SCHED_FIFO {self.priority}" if self.priority else "ordinary scheduling"]
        granted += [f"CPU {self.cpu}"] if self.cpu is not None else []
        granted += ["memory locked"] if self.memory_locked else []
        return "; ".join([", ".join(granted), *(f"not granted: {what}" for what in self.refused)])


def make_real_time(priority: int, cpu: int = -1, *, thread: int = 0, keeps_rights: bool = True) -> Scheduling:
    """Give a thread SCHED_FIFO, by default the calling one, and lock the process's memory; as far as allowed.

    `priority` is from 1 to 98; with 0 neither is done. `cpu` is the CPU to pin it to; -1: none. `thread` is
    another thread of this process: its `threading.Thread.native_id`. Threads that the thread starts later
    inherit its priority and CPU. `keeps_rights`: whether the process keeps its capabilities afterwards.
    """
    if sys.platform != "linux":
        return Scheduling(refused=("real-time scheduling (there is one on Linux only)",))
    refused = []
    if cpu >= 0:
        try:
            os.sched_setaffinity(thread, {cpu})
        except OSError:
            usable = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
            refused.append(f"CPU {cpu} (there are {usable})")
            cpu = -1
    locked = False
    if priority:
        try:
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        except (PermissionError, ProcessLookupError):
            refused.append(f"SCHED_FIFO {priority} ({_grants_priority(priority)})")
            priority = 0
        else:
            locked = _lock_memory(keeps_rights)
            if not locked:
                refused.append(f"locked memory ('memlock unlimited' in {_LIMITS}, LimitMEMLOCK=infinity)")
    return Scheduling(priority, cpu if cpu >= 0 else None, locked, tuple(refused))


def _grants_priority(priority: int) -> str:
    import resource  # noqa: PLC0415 - not on all systems

    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if limit >= priority or limit == resource.RLIM_INFINITY:
        return "a container, a control group or RestrictRealtime= forbids it"
    return f"'rtprio {priority}' in {_LIMITS}, LimitRTPRIO={priority} in a service's unit"


def _lock_memory(keeps_rights: bool) -> bool:
    """Whether it is locked. Not up to a limit: beyond it every allocation would fail without CAP_IPC_LOCK."""
    import resource  # noqa: PLC0415 - not on all systems

    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except (OSError, ValueError):
        if not (keeps_rights and _may_lock_all()):
            return False
    return bool(ctypes.CDLL(None).mlockall(_MLOCK) == 0)


def _may_lock_all() -> bool:
    """Whether this process has CAP_IPC_LOCK."""
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> _CAP_IPC_LOCK & 1)
    return False
