"""What is asked of the kernel is granted where allowed, and said in one line where not."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys

import pytest

PROBE = """
import gc, json, logging, os, sys
from ethercat_server.process import realtime
logging.basicConfig(format="%(message)s", stream=sys.stderr)
realtime.prepare({priority}, {cpu})
locked = next(l for l in open("/proc/self/status") if l.startswith("VmLck")).split()[1]
slack = open("/proc/self/timerslack_ns").read().strip()
print(json.dumps([os.sched_getscheduler(0), os.sched_getparam(0).sched_priority,
    sorted(os.sched_getaffinity(0)), int(locked), gc.isenabled(), slack]))
"""


def probe(priority: int, cpu: int | None, *, capable: bool = True) -> tuple[list[object], str]:
    def drop() -> None:
        for capability in (14, 23):  # CAP_IPC_LOCK, CAP_SYS_NICE
            ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)

    done = subprocess.run(
        [sys.executable, "-c", PROBE.format(priority=priority, cpu=cpu)],
        capture_output=True, text=True, check=True, preexec_fn=None if capable else drop,
    )  # fmt: skip
    return json.loads(done.stdout), done.stderr.strip()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to be granted real-time scheduling")
def test_granted() -> None:
    cpu = min(os.sched_getaffinity(0))
    (scheduler, priority, cpus, locked, collects, _), said = probe(40, cpu)
    if said:
        pytest.skip(
            f"root may not do everything here (a user namespace or container: run it as real root): {said}"
        )
    assert (scheduler, priority, cpus) == (os.SCHED_FIFO, 40, [cpu])
    assert isinstance(locked, int)
    assert locked > 0
    assert collects is False


def test_not_granted_is_one_line_and_it_runs_on() -> None:
    limit = os.sysconf("SC_NPROCESSORS_CONF") + 5
    (scheduler, _, _, _, collects, slack), said = probe(40, limit, capable=False)
    assert scheduler == os.SCHED_OTHER
    assert len(said.splitlines()) == 1
    assert said.startswith("not granted: ")
    assert f"CPU {limit}" in said
    assert "real-time priority 40 (CAP_SYS_NICE)" in said
    assert collects is False
    assert slack == "1000", "then at least the timer is made finer"


def test_ordinary_scheduling_is_a_choice() -> None:
    (scheduler, *_), said = probe(0, None)
    assert scheduler == os.SCHED_OTHER
    assert not said


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to be granted real-time scheduling")
def test_a_thread_can_leave_what_it_inherits() -> None:
    script = (
        PROBE.format(priority=40, cpu=min(os.sched_getaffinity(0)))
        + """
import threading
def other():
    realtime.leave()
    found.append([os.sched_getscheduler(0), sorted(os.sched_getaffinity(0))])
found = []
thread = threading.Thread(target=other)
thread.start()
thread.join()
print(json.dumps([*found[0], os.sched_getscheduler(0), len(os.sched_getaffinity(0))]))
"""
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    if said := done.stderr.strip():
        pytest.skip(
            f"root may not do everything here (a user namespace or container: run it as real root): {said}"
        )
    scheduler, cpus, own_scheduler, own_cpus = json.loads(done.stdout.splitlines()[-1])
    assert (scheduler, cpus) == (os.SCHED_OTHER, sorted(os.sched_getaffinity(0)))
    assert (own_scheduler, own_cpus) == (os.SCHED_FIFO, 1), "the loop keeps its own"
