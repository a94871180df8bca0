# SPDX-License-Identifier: Apache-2.0
"""The node's own process: environment, stop signals, scheduling, and threads that do not die silently.

Once the node is built SIGINT, SIGTERM and SIGHUP are an ordinary call from an ordinary thread. All are
blocked in every thread and one thread waits for them. A handler would run only when the main thread next
executes Python, which it does not while it waits inside ROS for the next message.

The stream's thread gets `rt_priority` and `cpu`. It takes locks that know no priorities, Python's (GIL) and
the middleware's: whoever holds one while another program has its CPU delays the stream, beside endless loops
by 2 to 5 ms. So the threads that often hold them get the priority just below: the monitor, the callbacks
that wait for no others, Fast DDS. The executor of the services stays ordinary.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from bota_ethercat.option_types import integer
from bota_ethercat.program.signals import asking

_REPEATED_SIGNAL_S: Final = 1.0
_HIGHEST_DOMAIN: Final = 232  # of DDS: the ports of others are too high
STREAM: Final = "reader"
SHARING_LOCKS: Final = ("monitor", "listener")  # threads that share Python's lock with the stream's
_MIDDLEWARE: Final = "dds."  # how Fast DDS names its threads
# Longest time that the stream waits for Python's lock. A sample takes less, so it is not interrupted.
_SWITCH_S: Final = 0.0002


class Worker(threading.Thread):
    """A daemon thread that tells why it has ended if that is an error."""

    def __init__(self, name: str, work: Callable[[], object], on_failure: Callable[[str], object]) -> None:
        super().__init__(name=name, daemon=True)
        self._work, self._on_failure = work, on_failure

    def run(self) -> None:
        try:
            self._work()
        except Exception as error:  # noqa: BLE001 - a thread that dies silently would leave a dead node
            self._on_failure(f"the {self.name} failed: {type(error).__name__}: {error}")

    def has_ended(self, within_s: float = 5.0) -> bool:
        self.join(within_s)
        return not self.is_alive()


def environment_problem() -> str:
    """What is wrong with variables at which the middleware would end the process; empty if nothing is."""
    middleware, domain = (os.environ.get(name, "") for name in ("RMW_IMPLEMENTATION", "ROS_DOMAIN_ID"))
    try:
        if middleware:
            ctypes.CDLL(f"lib{middleware}.so")
    except OSError as error:
        return (
            f"RMW_IMPLEMENTATION is {middleware!r}, which cannot be loaded ({error}): unset it, or install "
            "that middleware for this ROS"
        )
    number = 0
    with contextlib.suppress(ValueError):  # ROS itself refuses what is no number
        number = int(domain, 0)
    if number in range(_HIGHEST_DOMAIN + 1) or "zenoh" in middleware:
        return ""
    return f"ROS_DOMAIN_ID is {domain}: set it to {integer(0, _HIGHEST_DOMAIN).allowed}, or unset it"


def refuse(text: str, exit_code: int) -> int:
    sys.stderr.write(f"bridge-client: {text}\n")
    return exit_code


class StopSignals:
    """What asks the node to end, from here on; to be made by the main thread before there are others.

    They wait until `begin`. From there to `call` they have their default action: it ends the process even
    while ROS holds Python's lock.
    """

    def __init__(self) -> None:
        self._numbers = asking()
        signal.pthread_sigmask(signal.SIG_BLOCK, self._numbers)  # in all threads that this one starts, too
        self._call: Callable[[signal.Signals], object] = lambda _: None
        self._has_call = threading.Event()

    def begin(self) -> bool:
        """All is loaded, and ROS begins; False if a signal has come already."""
        if signal.sigtimedwait(self._numbers, 0) is not None:
            return False
        threading.Thread(target=self._wait, name="signals", daemon=True).start()
        return True

    def call(self, callback: Callable[[signal.Signals], object]) -> None:
        """Call `callback`, from a thread of its own, at the first signal from now on.

        A later one ends the process at once, but not one right behind the first: a terminal and a launcher
        may each send theirs.
        """
        self._call = callback
        self._has_call.set()

    def _wait(self) -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, self._numbers)
        self._has_call.wait()
        signal.pthread_sigmask(signal.SIG_BLOCK, self._numbers)
        self._call(signal.Signals(signal.sigwait(self._numbers)))
        impatient_s = time.monotonic() + _REPEATED_SIGNAL_S
        while True:
            number = signal.sigwait(self._numbers)
            if time.monotonic() >= impatient_s:
                os._exit(128 + number)


def favor_stream() -> None:
    """Let the stream's thread wait neither for Python's lock nor for the garbage of what is loaded by now."""
    sys.setswitchinterval(_SWITCH_S)
    gc.collect()
    gc.freeze()


def prepare(rt_priority: int, cpu: int, log: Any) -> None:
    """Give the node's threads, which run, their scheduling as far as allowed, and log one line of it."""
    from bota_ethercat.program.real_time import make_real_time  # noqa: PLC0415 - `client` says where it is missing

    if not rt_priority and cpu < 0:
        return
    stream = next((each.native_id for each in threading.enumerate() if each.name == STREAM), None)
    if stream is None:  # it has failed, and the node ends
        return
    scheduling = make_real_time(rt_priority, cpu, thread=stream)
    if scheduling.priority:
        below = os.sched_param(max(1, scheduling.priority - 1))
        for thread in _threads_sharing_locks():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(thread, os.SCHED_FIFO, below)
    if scheduling.refused:
        log.warning(f"the stream has {scheduling}; samples may be late on a busy machine")
    else:
        log.info(f"the stream has {scheduling}")


def _threads_sharing_locks() -> Iterator[int]:
    yield from (thread.native_id or 0 for thread in threading.enumerate() if thread.name in SHARING_LOCKS)
    for task in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            if (task / "comm").read_text(encoding="utf-8", errors="replace").startswith(_MIDDLEWARE):
                yield int(task.name)
