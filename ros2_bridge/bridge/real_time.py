"""Real-time scheduling of the node's own process: which thread gets what, and what is logged of it.

The stream's thread gets `rt_priority` and `cpu`. It takes locks that know no priorities, Python's (GIL) and
the middleware's: whoever holds one while another program has its CPU delays the stream, beside endless loops
by 2 to 5 ms. So the threads that do so all the time get the priority just below: the monitor, the callbacks
that wait for no others, Fast DDS. The executor of the services stays ordinary: what it does may take long.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from bota_ethercat.client.real_time import make_real_time
from bridge.parameters.table import Parameters

STREAM: Final = "reader"
BESIDE: Final = ("monitor", "listening")
"""Threads of the node that share Python's lock with the stream's."""
_MIDDLEWARE: Final = "dds."
"""How Fast DDS names its threads."""
_SWITCH_S: Final = 0.0002
"""Longest time that the stream waits for Python's lock. A sample takes less, so it is not interrupted."""


def prepare(parameters: Parameters, log: Any) -> None:
    """Give the node's threads, which run, their scheduling as far as allowed, and log one line of it."""
    if not parameters.rt_priority and parameters.cpu < 0:
        return
    stream = next((each.native_id for each in threading.enumerate() if each.name == STREAM), None)
    if stream is None:  # it has failed, and the node ends
        return
    scheduling = make_real_time(parameters.rt_priority, parameters.cpu, thread=stream)
    if scheduling.priority:
        below = os.sched_param(max(1, scheduling.priority - 1))
        for thread in _beside():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(thread, os.SCHED_FIFO, below)
        sys.setswitchinterval(_SWITCH_S)
        gc.collect()
        gc.freeze()  # what is loaded by now stays: no collection needs to look at it
    if scheduling.refused:
        log.warning(f"the stream has {scheduling}; samples may be late on a busy machine")
    else:
        log.info(f"the stream has {scheduling}")


def _beside() -> Iterator[int]:
    """The threads whose locks the stream needs."""
    yield from (thread.native_id or 0 for thread in threading.enumerate() if thread.name in BESIDE)
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            if (task / "comm").read_text(encoding="utf-8", errors="replace").startswith(_MIDDLEWARE):
                yield int(task.name)
