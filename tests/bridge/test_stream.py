"""What the node publishes: every fresh sample once, in SI units, and nothing else. One node for all tests."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    PATIENCE_S,
    Listener,
    NodeProcess,
    NodeThread,
    establish,
    process_starter,
    starter,
    wait_until,
)
from tests.bridge.scripted_server import ScriptedServer, description, process_data
from tests.bridge.shared import listener, server

__all__ = ["listener", "server"]
pytestmark = pytest.mark.ros


@pytest.fixture(scope="module")
def node(server: ScriptedServer, listener: Listener) -> Iterator[NodeThread]:
    with starter(listener) as start:
        yield start(server.port)


@pytest.fixture(autouse=True)
def _streaming(node: NodeProcess, server: ScriptedServer, listener: Listener) -> Iterator[None]:
    establish(server, listener)
    yield
    assert node.is_running
    assert "Traceback" not in node.log


def test_twelve_labelled_values_in_si_units(server: ScriptedServer, listener: Listener) -> None:
    server.send_sample(3.0)
    message = listener.messages.get(timeout=PATIENCE_S)
    raw = [3.0 + i / 16 for i in range(12)]
    expected = [*raw[:6], *(v * 9.80665 for v in raw[6:9]), *(math.radians(v) for v in raw[9:])]
    assert list(message.data) == pytest.approx(expected, rel=1e-12)
    (dimension,) = message.layout.dim
    assert (dimension.label, dimension.size, dimension.stride) == (
        "Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz", 12, 12
    )  # fmt: skip
    assert message.layout.data_offset == 0


def test_every_fresh_sample_once_and_in_order(server: ScriptedServer, listener: Listener) -> None:
    heard = []
    for number in range(100):
        server.send_sample(number)
        time.sleep(0.001)
        if number % 5 == 4:  # a topic keeps ten: a subscriber that is starved of its CPU would miss some
            heard += [listener.next_number() for _ in range(5)]
    assert heard == list(range(100))


def test_samples_that_come_together_are_all_published(server: ScriptedServer, listener: Listener) -> None:
    server.send_raw(b"".join(server.frame(number) for number in range(8)))
    assert [listener.next_number() for _ in range(8)] == list(range(8))


def test_both_sizes_of_process_data(server: ScriptedServer, listener: Listener) -> None:
    server.send_sample(0, process_data=process_data(5.0, 77))
    server.send_sample(6.0)
    assert [listener.next_number() for _ in range(2)] == [5.0, 6.0]


def test_a_sensor_that_goes_and_comes_back(
    server: ScriptedServer, listener: Listener, node: NodeThread
) -> None:
    server.description = description(sensors=[])
    server.drop()
    node.says("the server has no sensor 0")
    server.description = description()
    establish(server, listener)
    server.send_sample(1.0)
    assert listener.next_number() == 1.0


@pytest.mark.usefixtures("_ros")
def test_nothing_old_after_the_node_was_stopped() -> None:
    """In a process: it is stopped, and what comes meanwhile waits in the kernel."""
    listener = Listener()
    with ScriptedServer() as server, process_starter(listener) as start:
        node = start(server.port)
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
    listener.close()
