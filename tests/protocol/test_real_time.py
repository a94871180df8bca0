"""Real-time scheduling of a client: granted by capability or limit, else said with a remedy."""

from __future__ import annotations

import ctypes
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from bota_ethercat.program import real_time
from tests.rights import IPC_LOCK, SYS_RESOURCE, limited, needs_limits, needs_root, skip_if_forbidden

PROBE = """
import json, os, sys, threading
from bota_ethercat.client import make_real_time
stop = threading.Event()
other = threading.Thread(target=stop.wait)
other.start()
which = other.native_id if sys.argv[3:] else 0
given = make_real_time(int(sys.argv[1]), int(sys.argv[2]), thread=which)
locked = next(line for line in open("/proc/self/status") if line.startswith("VmLck")).split()[1]
print(json.dumps({"text": str(given), "priority": given.priority, "cpu": given.cpu, "locked": int(locked) > 0,
    "own": [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, sorted(os.sched_getaffinity(0))],
    "others": [os.sched_getscheduler(other.native_id), os.sched_getparam(other.native_id).sched_priority]}))
stop.set()
"""
ALL = sorted(os.sched_getaffinity(0))
ORDINARY = [os.SCHED_OTHER, 0]


def probe(*arguments: object, limit: Callable[[], None] | None = None) -> dict[str, Any]:
    command = [sys.executable, "-c", PROBE, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, preexec_fn=limit)
    found: dict[str, Any] = json.loads(done.stdout)
    skip_if_forbidden(found["text"])
    return found


@needs_root
def test_granted_for_the_calling_thread_alone() -> None:
    found = probe(40, ALL[-1])
    assert found["own"] == [os.SCHED_FIFO, 40, [ALL[-1]]]
    assert found["others"] == ORDINARY
    assert found["locked"]
    assert found["text"] == f"SCHED_FIFO 40, CPU {ALL[-1]}, memory locked"


@needs_limits
def test_limits_alone_grant_it_for_another_thread() -> None:
    found = probe(30, -1, "other", limit=limited(30, resource.RLIM_INFINITY))
    assert found["own"] == [*ORDINARY, ALL]
    assert found["others"] == [os.SCHED_FIFO, 30]
    assert found["text"] == "SCHED_FIFO 30, memory locked"


def test_refused_with_what_would_grant_it() -> None:
    missing = os.sysconf("SC_NPROCESSORS_CONF") + 5
    found = probe(40, missing, limit=limited())
    assert found["own"] == [*ORDINARY, ALL]
    assert (found["priority"], found["cpu"], found["locked"]) == (0, None, False)
    usable = ", ".join(map(str, ALL))
    assert found["text"] == (
        f"ordinary scheduling; not granted: CPU {missing} (there are {usable}); not granted: SCHED_FIFO 40 "
        "('rtprio 40' in a file in /etc/security/limits.d, LimitRTPRIO=40 in a service's unit)"
    )


@pytest.mark.parametrize("may_lock_all", [True, False])
def test_memory_is_not_locked_where_the_limit_suffices_only_now(
    may_lock_all: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel would lock it; what the process allocates later would fail."""

    def refuse(*_: object) -> None:
        raise ValueError("not allowed to raise maximum limit")

    monkeypatch.setattr(resource, "setrlimit", refuse)
    monkeypatch.setattr(real_time, "_may_lock_all", lambda: may_lock_all)
    monkeypatch.setattr(ctypes, "CDLL", lambda _: SimpleNamespace(mlockall=lambda _: 0))
    assert real_time._lock_memory(keeps_rights=True) == may_lock_all
    assert not real_time._lock_memory(keeps_rights=False)


@needs_root
def test_memory_is_not_locked_up_to_a_limit() -> None:
    found = probe(40, -1, limit=limited(lacks=(IPC_LOCK, SYS_RESOURCE)))
    assert found["own"][:2] == [os.SCHED_FIFO, 40]
    assert not found["locked"]
    assert "not granted: locked memory ('memlock unlimited' in a file in" in found["text"]
