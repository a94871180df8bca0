"""The node against the real server and a virtual sensor: all that only shows when both are what they are.

Each is a process, as in use.
"""

from __future__ import annotations

import json
import queue
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Imu

from tests.bridge.conftest import PATIENCE_S, Listener, NodeProcess, process_starter, wait_until
from tests.bridge.shared import listener
from tests.bridge.streaming import Diagnostics, values
from tests.server.running import Program, Server, needs_bus, virtual_sensor

__all__ = ["listener"]
pytestmark = [pytest.mark.ros, pytest.mark.bus, needs_bus]
OK, WARN, ERROR, STALE = range(4)
SLOW = ("--set", "sinc_length=512")
"""100 samples a second: what is tested here is no question of speed."""
THERE = {"link": OK, "sensor": OK}
"""Whether the stream is whole and the clock locked is the machine's business: see test_diagnostics."""


class Bench:
    """A virtual sensor, the server on it, the node, and who listens."""

    def __init__(self, ifname: str, sensor: Program, listener: Listener) -> None:
        self.ifname, self.sensor, self.listener = ifname, sensor, listener
        self.server = Server(ifname, *SLOW).wait_streaming()
        self.port = self.server.port
        self.diagnostics = Diagnostics(listener)
        self.wrench: queue.Queue[Any] = listener.subscribe(WrenchStamped, "wrench", depth=20)

    def restart_server(self) -> None:
        self.server.close()
        self.server = Server(self.ifname, *SLOW, port=self.port).wait_streaming()

    def command(self, text: str) -> None:
        assert self.sensor.process.stdin is not None
        self.sensor.process.stdin.write(text + "\n")
        self.sensor.process.stdin.flush()

    def answer(self, ask: Callable[[], tuple[bool, str]]) -> tuple[bool, str]:
        """Whether it was done, and what is said; asked again while a busy machine has lost the sensor."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            done, text = ask()
            if done or "(not_ready)" not in text:
                return done, text
            assert time.monotonic() < deadline, text

    def granted(self, ask: Callable[[], tuple[bool, str]]) -> str:
        """What is said once it is done."""
        done, text = self.answer(ask)
        assert done, text
        return text

    def forget(self) -> None:
        while not self.wrench.empty():
            self.wrench.get()
        self.diagnostics.forget()

    def next_wrench(self) -> Any:
        return self.wrench.get(timeout=20)

    def age_s(self, message: Any) -> float:
        stamp = message.header.stamp
        return time.time() - float(stamp.sec) - float(stamp.nanosec) / 1e9


@pytest.fixture(scope="module")
def _bench(listener: Listener) -> Iterator[Bench]:
    with virtual_sensor("--pdo", "77", "--signal", "poses") as (veth, sensor):
        bench = Bench(veth.near, sensor, listener)
        try:
            yield bench
        finally:
            bench.server.close()


@pytest.fixture(scope="module")
def node(_bench: Bench, listener: Listener) -> Iterator[NodeProcess]:
    with process_starter(listener) as start:
        tolerant = {
            "diagnostics.age_warn": 1.0,
            "diagnostics.rate_tolerance": 0.2,
            "diagnostics.lost_warn": 20,
        }
        yield start(_bench.port, **tolerant)


@pytest.fixture
def bench(_bench: Bench, node: NodeProcess) -> Iterator[Bench]:
    _bench.diagnostics.until(**THERE)
    _bench.forget()
    yield _bench
    assert node.is_running
    assert "Traceback" not in node.log


def test_gravity_and_orientation(bench: Bench, listener: Listener) -> None:
    imu = listener.subscribe(Imu, "imu/data_raw").get(timeout=20)
    a = imu.linear_acceleration
    assert (a.x**2 + a.y**2 + a.z**2) ** 0.5 == pytest.approx(9.8, abs=2.0)
    assert imu.orientation_covariance[0] == -1.0  # mapped, but not estimated
    bench.granted(lambda: listener.set_parameter("settings.orientation_estimation", True))
    messages = listener.subscribe(Imu, "imu/data_raw")
    wait_until(lambda: messages.get(timeout=20).orientation_covariance[0] == 0.0, "an orientation")
    bench.forget()  # what has come since the test began
    assert bench.age_s(bench.next_wrench()) < 10


def test_settings(bench: Bench, listener: Listener) -> None:
    assert listener.parameters("settings.sinc_length", "settings.chop") == [512, False]
    bench.granted(lambda: listener.set_parameter("settings.sinc_length", 256))
    text = bench.granted(lambda: listener.trigger("get_settings"))
    assert (json.loads(text)["sinc_length"], json.loads(text)["rate_hz"]) == (256, 200)
    wait_until(
        lambda: values(bench.diagnostics.next()["stream"])["expected_hz"] == "200.0", "the rate expected"
    )
    bench.diagnostics.until(**THERE)
    done, reason = bench.answer(lambda: listener.set_parameter("settings.fast", True))
    assert not done
    assert "FAST filter works only with the FIR filter on (bad_request)" in reason
    with bench.server.connect() as other:
        change = {"temperature_compensation": True}
        wait_until(lambda: other.ask("configure", settings=change)["ok"], "the other's change")
    wait_until(
        lambda: listener.parameters("settings.temperature_compensation") == [True], "what the other changed"
    )
    bench.granted(lambda: listener.trigger("save_settings"))


def test_tare(bench: Bench, listener: Listener) -> None:
    for _ in range(20):  # between its poses the wrist turns
        done, text = bench.answer(lambda: listener.trigger("sensor_tare"))
        if done:
            break
        assert "is not at rest" in text
    assert done, text
    assert "old offset Fx 0.0000" in text
    assert "residual Fx" in text


def test_a_server_that_stood_still(bench: Bench) -> None:
    bench.server.signal(signal.SIGSTOP)
    try:
        bench.diagnostics.until("no new sample for", stream=ERROR, clock=STALE)
        time.sleep(2.0)
        bench.forget()
    finally:
        bench.server.signal(signal.SIGCONT)
    first = bench.next_wrench()
    assert bench.age_s(first) < 1.5  # those of before are 2 s old
    array = bench.diagnostics.until("samples lost", stream=WARN)
    assert int(values(array["stream"])["lost"]) > 100


def test_a_sensor_without_power(bench: Bench) -> None:
    bench.command("power off")
    bench.diagnostics.until("is lost", sensor=ERROR, stream=ERROR, clock=STALE)
    bench.forget()
    time.sleep(0.3)
    assert bench.wrench.empty()
    bench.command("power on")
    began = time.time()
    first = bench.next_wrench()
    assert first.header.stamp.sec + first.header.stamp.nanosec / 1e9 > began
    bench.diagnostics.until(**THERE)


def test_a_server_that_starts_again(bench: Bench, listener: Listener) -> None:
    bench.server.close()
    bench.diagnostics.until(link=ERROR, stream=STALE)
    assert listener.parameters("settings.sinc_length") == [None]
    bench.restart_server()
    array = bench.diagnostics.until(**THERE)
    assert values(array["link"])["reconnects"] == "1"
    assert listener.parameters("settings.sinc_length") == [512]  # not what the node had asked for
    bench.forget()  # what has come since the restart
    assert bench.age_s(bench.next_wrench()) < 10
