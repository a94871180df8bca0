"""Asks the kernel for what a steady cycle needs: real-time scheduling, locked memory, a CPU, a fine timer.

Each is used when allowed; what is not is said in one line and the server runs on without it.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import sys
from pathlib import Path
from typing import Final

_MLOCK: Final = 1 | 2 | 4
"""MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT: what is in use stays in memory, without filling what is not."""
_TIMER_SLACK_NS: Final = "1000"
_SWITCH_S: Final = 0.0002
"""The longest that the loop waits for another thread of this process; Python's default would cost samples."""

log = logging.getLogger(__name__)


def prepare(priority: int, cpu: int | None) -> None:
    """Prepare this process for the acquisition loop.

    `priority` is that of SCHED_FIFO, 1 to 99, or 0 for ordinary scheduling; `cpu` the only CPU to run on.
    """
    refused = []
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError:
            refused.append(f"CPU {cpu}")
    try:
        if priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        refused.append(f"real-time priority {priority} (CAP_SYS_NICE)")
        _fine_timer()
    if not priority:
        _fine_timer()
    if priority and ctypes.CDLL(None).mlockall(_MLOCK) != 0:
        refused.append("locked memory (CAP_IPC_LOCK)")
    if refused:
        log.warning("not granted: %s; the cycle will be less steady", ", ".join(refused))
    sys.setswitchinterval(_SWITCH_S)
    # Nothing the loop makes needs the collector: what start-up left is set aside, and cycles are not made.
    gc.collect()
    gc.freeze()
    gc.disable()


def _fine_timer() -> None:
    """An ordinary thread's sleep may be 50 µs late by default, for the sake of power; a FIFO thread's not."""
    try:
        Path("/proc/self/timerslack_ns").write_text(_TIMER_SLACK_NS, encoding="ascii")
    except OSError:
        log.debug("the timer slack stays as it is")
