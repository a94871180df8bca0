"""The node and the server: everything that only shows when both are what they are, in simulated time.

One test has both as processes, as in use.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from geometry_msgs.msg import WrenchStamped

from ethercat_server.virtual_sensor.measurement.scene import TOOL_CENTRE, TOOL_MASS
from ethercat_server.virtual_sensor.measurement.signals import CONSTANT
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.bridge.compensating import six, stamp_ns
from tests.bridge.conftest import PATIENCE_S, Listener, StartProcess
from tests.bridge.simulated_node import SimulatedNode
from tests.bridge.streaming import Diagnostics, values
from tests.bridge.whole_server import WholeServer
from tests.server.running import needs_bus
from tests.server.running import server as server_process

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("_ros")]
OK, WARN, ERROR, STALE = range(4)
HEALTHY = {"link": OK, "stream": OK, "sensor": OK, "clock": OK, "compensation": OK}
NOISE_N = 0.072
"""Standard deviation of a force at SINC 512: 0.3 N at 51, falling with the length to the power of 0.62."""


@pytest.fixture
def server() -> WholeServer:
    return WholeServer(SensorOptions(signal="poses", pdo_size=77))


@pytest.fixture
def node(server: WholeServer) -> Iterator[SimulatedNode]:
    with SimulatedNode(server) as started:
        started.until(**HEALTHY)
        yield started


def test_gravity_and_orientation(node: SimulatedNode, server: WholeServer) -> None:
    messages, oriented = node.hear("imu/data_raw"), node.hear("imu/data")
    node.run(0.3)
    a = messages[-1].linear_acceleration
    assert math.hypot(a.x, a.y, a.z) == pytest.approx(9.8, abs=0.5)
    assert not oriented  # mapped, but not estimated
    assert node.set_parameter("settings.orientation_estimation", True) == (True, "")
    node.run(0.3)
    assert messages[-1].orientation_covariance[0] == -1.0
    assert oriented[-1].orientation_covariance[0] == 0.0
    assert server.time_ns() - stamp_ns(messages[-1]) < 20e6


def test_settings(node: SimulatedNode, server: WholeServer) -> None:
    assert node.parameters("settings.sinc_length", "settings.chop") == [512, False]
    assert node.set_parameter("settings.sinc_length", 256) == (True, "")
    done, text = node.trigger("get_settings")
    assert done
    assert (json.loads(text)["sinc_length"], json.loads(text)["rate_hz"]) == (256, 200)
    array = node.until("200 samples a second", stream=OK)
    assert values(array["stream"])["expected_hz"] == "200.0"
    done, reason = node.set_parameter("settings.fast", True)
    assert not done
    assert "FAST filter works only with the FIR filter on (bad_request)" in reason
    other = server.simulation.connect()
    other.send("configure", settings={"temperature_compensation": True})
    node.run_until(lambda: other.replies, "the reply to the other")
    assert other.replies[0]["ok"]
    assert node.parameters("settings.temperature_compensation") == [True], "what the other changed"
    assert node.trigger("save_settings")[0]
    assert "0x8030" in [row["index"] for row in server.simulation.stats()["sdo_writes"]]


def test_tare(node: SimulatedNode) -> None:
    refused: list[str] = []
    while True:  # between its poses the wrist turns
        done, text = node.trigger("sensor_tare")
        if done and refused:
            break
        refused += [] if done else [text]
    assert all("is not at rest" in text for text in refused)
    assert "residual Fx" in text


def test_a_tare_of_a_moving_sensor_is_refused() -> None:
    with SimulatedNode(WholeServer(SensorOptions(signal="scene"))) as node:
        node.run(1.0)
        answers = [node.trigger("sensor_tare") for _ in range(3)]
    assert not all(done for done, _ in answers)
    for done, text in answers:
        if done:  # it rested for a moment
            residuals = [float(value) for value in re.findall(r"-?\d+\.\d+", text.partition("residual")[2])]
            assert max(map(abs, residuals[:3])) < 0.4
        else:
            assert "is not at rest" in text or "moved during the tare" in text
            assert f"sensor_tare failed: {text}" in node.log


def test_another_clients_tare_shifts_the_bias() -> None:
    server = WholeServer(SensorOptions(signal="rest"))
    with SimulatedNode(server, bias_ramp_time=0.0) as node:
        wrenches = node.hear("wrench_compensated")
        node.run(1.5)
        assert node.trigger("tare")[0]
        other = server.simulation.connect()
        other.send("tare", samples=20)
        wrenches.clear()
        node.run_until(lambda: other.replies, "the reply to the other")
        assert min(map(abs, other.replies[0]["new_offset"][:3])) > 1.0
        node.run(0.2)
        worst = [max(map(abs, six(message)[:3])) for message in wrenches]
        assert worst[-1] < 0.5, "the sensor's noise"
        assert sum(one > 0.5 for one in worst) <= 13, "while six numbers are written and read, a sample each"
        node.until(compensation=OK)


def test_a_server_that_stood_still(node: SimulatedNode, server: WholeServer) -> None:
    wrenches = node.hear("wrench")
    server.is_stopped = True
    node.until("No new sample for", "the server does not answer", stream=ERROR, clock=STALE)
    node.run(2.0)
    wrenches.clear()
    server.is_stopped = False
    went_on_ns = server.time_ns()
    array = node.until(" were lost", stream=ERROR)
    assert int(values(array["stream"])["lost"]) > 100
    assert stamp_ns(wrenches[0]) > went_on_ns - 20e6, "nothing old"
    node.until(**HEALTHY)


def test_a_sensor_without_power(node: SimulatedNode, server: WholeServer) -> None:
    wrenches = node.hear("wrench")
    server.simulation.command("power off")
    node.until("is lost", sensor=ERROR, stream=ERROR, clock=STALE)
    wrenches.clear()
    node.run(1.0)
    assert not wrenches
    server.simulation.command("power on")
    power_on_ns = server.time_ns()
    node.until(**HEALTHY)
    assert stamp_ns(wrenches[0]) > power_on_ns


def test_a_server_that_starts_again(node: SimulatedNode, server: WholeServer) -> None:
    assert node.set_parameter("settings.sinc_length", 256) == (True, "")
    wrenches = node.hear("wrench")
    server.close()
    node.until(link=ERROR, stream=STALE)
    assert node.parameters("settings.sinc_length") == [None]
    wrenches.clear()
    server.start_again()
    started_ns = server.time_ns()
    array = node.until("was interrupted", link=WARN)
    assert values(array["link"])["reconnects"] == "1"
    node.until(**HEALTHY)
    assert node.parameters("settings.sinc_length") == [512]  # not what the node had asked for
    assert stamp_ns(wrenches[0]) > started_ns


def test_from_poses_to_the_force_of_the_environment(tmp_path: Path) -> None:
    """Identification and compensation as a user does them; the accelerometer is the only source."""
    server = WholeServer(SensorOptions(signal="poses"))
    with SimulatedNode(server, bias_directory=tmp_path) as node:
        node.run(0.1)
        assert node.trigger("identify/start")[0]
        taken = 0
        while taken < 6:
            done, text = node.trigger("identify/add_pose")
            if done:
                taken += 1
                node.run(3.0)  # until it has begun to turn to the next
            else:
                assert any(words in text for words in ("stationary", "turns")), text
        done, text = node.trigger("identify/solve")
        assert done, text
        assert node.trigger("identify/apply")[0]
        mass, center = node.parameters("tool_mass", "tool_center_of_gravity")
        assert mass == pytest.approx(TOOL_MASS, rel=0.01)
        assert list(center) == pytest.approx(TOOL_CENTRE, abs=0.002)
        server.simulation.command("signal turn")
        wrenches = node.hear("wrench_compensated")
        node.run(2.0)
        wrenches.clear()
        node.run(5.0)
        node.until("subtracted: bias, weight and inertia of the tool", compensation=OK)
        rows = [six(message)[:3] for message in wrenches]
        assert len(rows) > 490
        rms = [math.sqrt(sum(row[axis] ** 2 for row in rows) / len(rows)) for axis in range(3)]
        assert max(rms) < 1.5 * NOISE_N
        beyond = sum(abs(part) > 3 * NOISE_N for row in rows for part in row)
        assert beyond < 0.01 * 3 * len(rows)  # of noise alone 0.27 % would be
        # What the environment does shows: in the scene the tool touches something after 5 s.
        server.simulation.command("signal scene")
        node.run(1.0)
        wrenches.clear()
        node.run(5.0)
        assert min(six(message)[2] for message in wrenches) < -10.0


@needs_bus
@pytest.mark.bus
def test_both_as_processes(listener: Listener, start_process: StartProcess) -> None:
    """As in use, with pysoem, TCP, DDS and signals: from the first sample to the end of both."""
    with server_process("virtual", "--virtual=--signal rest", "--set", "sinc_length=512") as running:
        node = start_process(running.port)
        diagnostics, wrenches = Diagnostics(listener), listener.subscribe(WrenchStamped, "wrench", depth=20)
        assert six(wrenches.get(timeout=PATIENCE_S)) == pytest.approx(CONSTANT)
        array = diagnostics.until(link=OK, sensor=OK)
        assert values(array["stream"])["expected_hz"] == "100.0"

        def granted(ask: Callable[[], tuple[bool, str]]) -> None:
            """Asked again while a busy machine has lost the sensor."""
            deadline = time.monotonic() + PATIENCE_S
            while not (answer := ask())[0]:
                assert "(not_ready)" in answer[1], answer
                assert time.monotonic() < deadline, answer

        granted(lambda: listener.set_parameter("settings.chop", True))
        assert listener.parameters("settings.chop") == [True]
        granted(lambda: listener.trigger("sensor_tare"))
        listener.supervise("ft_sensors", "1")
        assert node.ends() == 0
        assert running.wait() == 0
        assert "Traceback" not in node.log
