"""Real-time settings of the acquisition loop; what is not permitted is logged in one line."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
from pathlib import Path
from typing import Final

from bota_ethercat.program.real_time import make_real_time

DEFAULT_PRIORITY: Final = 80  # SCHED_FIFO priority of the acquisition loop
_TIMER_SLACK_NS: Final = "1000"
# Longest time the loop waits for another thread of this process; Python's default of 5 ms loses samples.
_SWITCH_S: Final = 0.0002

_ALL_CPUS: Final = frozenset(os.sched_getaffinity(0))  # the CPUs that this process may use, as of its start

log = logging.getLogger(__name__)


def prepare(priority: int, cpu: int | None, *, becomes_user: bool = False) -> None:
    """Prepare this thread and process for the acquisition loop; threads started later inherit its scheduling.

    `priority` is that of SCHED_FIFO, 1 to 99, or 0 for ordinary scheduling; `cpu` is the CPU to pin it to;
    `becomes_user` if the process gives up its capabilities afterwards, which ends none of it.
    """
    scheduling = make_real_time(priority, -1 if cpu is None else cpu, keeps_rights=not becomes_user)
    if not scheduling.priority:
        # By default an ordinary thread's sleep may end 50 µs late, a FIFO thread's not.
        with contextlib.suppress(OSError):
            Path("/proc/self/timerslack_ns").write_text(_TIMER_SLACK_NS, encoding="ascii")
    if scheduling.refused:
        log.warning("not granted: %s; expect more jitter", ", ".join(scheduling.refused))
    sys.setswitchinterval(_SWITCH_S)
    # The loop makes no reference cycles, so it needs no collector, which would pause it: a look at the newest
    # objects once a second is enough.
    gc.collect()
    gc.freeze()
    gc.disable()


def leave() -> None:
    """Give the calling thread ordinary scheduling on all CPUs: what it does must not delay the loop."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, _ALL_CPUS)
