"""The node's scheduling: the stream's thread, those whose locks it needs, and what is said of it."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bota_ethercat.client import Scheduling
from bridge import real_time
from bridge.parameters.table import DEFAULTS
from tests.bridge.conftest import StartProcess
from tests.bridge.scripted_server import ScriptedServer
from tests.limited import needs_root, skip_if_forbidden

pytestmark = pytest.mark.ros
DEFAULT = DEFAULTS.rt_priority
BELOW = DEFAULT - 1


@needs_root
def test_the_streams_thread_is_real_time_and_no_service_is(
    server: ScriptedServer, start_process: StartProcess
) -> None:
    cpu = min(os.sched_getaffinity(0))
    node = start_process(server.port, cpu=cpu)
    node.says("connected to")
    node.says("the stream has ")
    skip_if_forbidden(node.log)
    assert f"the stream has SCHED_FIFO {DEFAULT}, CPU {cpu}, memory locked" in node.log
    found: Counter[tuple[str, int, object, bool]] = Counter()
    for task in Path(f"/proc/{node.process.pid}/task").iterdir():
        name, number = (task / "comm").read_text().strip(), int(task.name)
        policy, priority = os.sched_getscheduler(number), os.sched_getparam(number).sched_priority
        found[name.split(".")[0], policy, priority, len(os.sched_getaffinity(number)) == 1] += 1
        assert number != node.process.pid or policy == os.SCHED_OTHER, "the services' executor"
    anywhere = os.cpu_count() == 1
    names = {name for name, *_ in found} - {"dds"}
    assert sum(found[name, os.SCHED_FIFO, DEFAULT, True] for name in names) == 1
    assert sum(found[name, os.SCHED_FIFO, BELOW, anywhere] for name in names) == len(real_time.BESIDE)
    assert {key[1:3] for key in found if key[0] == "dds"} == {(os.SCHED_FIFO, BELOW)}
    assert {key[1:3] for key in found} == {
        (os.SCHED_OTHER, 0), (os.SCHED_FIFO, BELOW), (os.SCHED_FIFO, DEFAULT)
    }  # fmt: skip


class Lines:
    def __init__(self) -> None:
        self.infos: list[str] = []
        self.warnings: list[str] = []
        self.info, self.warning = self.infos.append, self.warnings.append


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Thread]:
    """A thread of the stream's name, and no way to change the process of the tests."""
    over = threading.Event()
    thread = threading.Thread(target=over.wait, name=real_time.STREAM)
    thread.start()
    for owner, name in ((sys, "setswitchinterval"), (os, "sched_setscheduler"), (gc, "freeze")):
        monkeypatch.setattr(owner, name, lambda *_: pytest.fail("nothing was granted"))
    yield thread
    over.set()
    thread.join()


def test_what_is_refused_is_a_warning_and_changes_nothing(
    stream: threading.Thread, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, int, int]] = []

    def refuse(priority: int, cpu: int, *, thread: int) -> Scheduling:
        asked.append((priority, cpu, thread))
        return Scheduling(refused=(f"SCHED_FIFO {priority} (a remedy)",))

    monkeypatch.setattr(real_time, "make_real_time", refuse)
    lines = Lines()
    parameters = DEFAULTS._replace(rt_priority=40, cpu=1)
    real_time.prepare(parameters, lines)
    assert asked == [(40, 1, stream.native_id)]
    assert not lines.infos
    assert lines.warnings == [
        "the stream has ordinary scheduling; not granted: SCHED_FIFO 40 (a remedy); samples may be late on a "
        "busy machine"
    ]


@pytest.mark.usefixtures("stream")
def test_nothing_is_said_where_nothing_was_asked_for() -> None:
    lines = Lines()
    real_time.prepare(DEFAULTS._replace(rt_priority=0), lines)
    assert not lines.infos + lines.warnings
