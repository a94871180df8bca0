"""The stream in real time, by TCP and DDS: every fresh sample once and in order, and nothing old."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.bridge.conftest import Listener, Start, StartProcess, establish, wait_until
from tests.bridge.scripted_server import ScriptedServer

pytestmark = pytest.mark.ros


def test_every_fresh_sample_once_and_in_order(
    server: ScriptedServer, listener: Listener, start: Start
) -> None:
    node = start(server.port)
    establish(server, listener)
    heard = []
    for number in range(100):
        server.send_sample(number)
        time.sleep(0.001)
        if number % 5 == 4:  # a topic keeps ten: a subscriber that is starved of its CPU would miss some
            heard += [listener.next_number() for _ in range(5)]
    assert heard == list(range(100))
    server.send_raw(b"".join(server.frame(number) for number in range(8)))
    assert [listener.next_number() for _ in range(8)] == list(range(8)), "that came together"
    assert "Traceback" not in node.log


def test_nothing_old_after_the_node_was_stopped(
    server: ScriptedServer, listener: Listener, start_process: StartProcess
) -> None:
    """In a process: it is stopped, and what comes meanwhile waits in the kernel."""
    node = start_process(server.port)
    establish(server, listener)
    node.send_signal(signal.SIGSTOP)
    state = Path(f"/proc/{node.process.pid}/stat")
    wait_until(lambda: state.read_text().rpartition(") ")[2].startswith("T"), "the node to stand still")
    began_ns = time.monotonic_ns() - 10**9
    for number in range(500):
        server.send_sample(number, monotonic_ns=began_ns + number * 1_250_000)
    server.send_sample(1000.0)
    node.send_signal(signal.SIGCONT)
    assert listener.next_number() == 1000.0
    server.send_sample(1001.0)
    assert listener.next_number() == 1001.0
