"""The node and the server: everything that only shows when both are what they are, in simulated time.

One test has both as processes, as in use.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped

from bota_ethercat.errors import UnreachableError
from ethercat_server.acquisition.stream import OutgoingFrame
from ethercat_server.virtual_sensor.options import SensorOptions
from ethercat_server.virtual_sensor.signals import CONSTANT, TOOL_CENTRE, TOOL_MASS
from tests.bridge.real_node import PATIENCE_S, Listener, StartProcess
from tests.bridge.simulated_node import HEALTHY, STEP_S, Node, Wire, level, six, stamp_ns, values
from tests.server.running import needs_bus
from tests.server.running import server as server_process
from tests.simulation import Simulation

# Standard deviation of a force at SINC 512: 0.3 N at 51, falling with the length to the power of 0.62.
NOISE_N = 0.072
SLOW = {"sinc_length": 512}  # 100 samples a second: what is tested here is no question of speed


class Serving(Simulation):
    """Stops after each sample, so that the node gets it at once."""

    def note(self, made: Sequence[OutgoingFrame]) -> None:
        super().note(made)
        self.cycle.stop()


class WholeServer:
    """A `World`. Samples come at 100 Hz."""

    def __init__(self, *sensors: SensorOptions) -> None:
        self.simulation = Serving(*sensors, settings=SLOW)
        self.clock = self.simulation.clock
        self.monotonic_ns, self.time_ns = self.clock.monotonic_ns, self.clock.time_ns
        self.is_stopped = False  # as by SIGSTOP
        self._wire: Wire | None = None

    def accept(self, wire: Wire) -> Callable[[bytes], object]:
        try:
            self._stream = self.simulation.transport.connect()
        except ConnectionRefusedError:
            raise UnreachableError("Connection refused") from None
        self._wire = wire
        return self._stream.send

    def close(self) -> None:
        """End the server, as by SIGTERM."""
        self.simulation.close()

    def start_again(self) -> None:
        """Start another server on the same sensors."""
        self.simulation = Serving(backend=self.simulation.backend, settings=SLOW)

    def step(self) -> None:
        """Let time pass until there is something for the node, STEP_S at most."""
        until_ns = self.clock.now_ns + round(STEP_S * 1e9)
        if self.is_stopped or not self.simulation.transport.listening():
            self.clock.advance(until_ns)
        else:
            self.simulation.run(STEP_S)
        if self._wire is not None:
            self._wire.feed(self._stream.recv_all())
            if self._stream.at_end:
                self._wire.end()
                self._wire = None


@pytest.fixture
def server() -> WholeServer:
    return WholeServer(SensorOptions(signal="poses", pdo_size=77))


@pytest.fixture
def node(server: WholeServer) -> Iterator[Node]:
    with Node(server) as started:
        started.until(**HEALTHY)
        yield started


def test_settings(node: Node, server: WholeServer) -> None:
    assert node.parameters("settings.sinc_length", "settings.chop") == [512, False]
    node.set("settings.sinc_length", 256)
    text = node.do("get_settings")
    assert (json.loads(text)["sinc_length"], json.loads(text)["rate_hz"]) == (256, 200)
    array = node.until("200 samples a second", stream="ok")
    assert values(array["stream"])["expected_hz"] == "200.0"
    node.refuse_value("settings.fast", True, "FAST filter works only with the FIR filter on (bad_request)")
    other = server.simulation.connect()
    other.send("configure", settings={"temperature_compensation": True})
    node.run_until(lambda: other.replies, "the reply to the other")
    assert other.replies[0]["ok"]
    assert node.parameters("settings.temperature_compensation") == [True], "what the other changed"
    node.do("save_settings")
    assert "0x8030" in [row["index"] for row in server.simulation.stats()["sdo_writes"]]


def test_another_clients_tare_shifts_the_bias() -> None:
    server = WholeServer(SensorOptions(signal="rest"))
    with Node(server, bias_ramp_time=0.0) as node:
        wrenches = node.hear("wrench_compensated")
        node.run(1.5)
        node.do("tare")
        other = server.simulation.connect()
        other.send("tare", samples=20)
        wrenches.clear()
        node.run_until(lambda: other.replies, "the reply to the other")
        assert min(map(abs, other.replies[0]["new_offset"][:3])) > 1.0
        node.run(0.2)
        worst = [max(map(abs, six(message)[:3])) for message in wrenches]
        assert worst[-1] < 0.5, "the sensor's noise"
        assert sum(one > 0.5 for one in worst) <= 13, "while six numbers are written and read, a sample each"
        node.until(compensation="ok")


def test_a_server_that_stood_still(node: Node, server: WholeServer) -> None:
    wrenches = node.hear("wrench")
    server.is_stopped = True
    node.until("No new sample for", "the server does not answer", stream="error", clock="stale")
    node.run(2.0)
    wrenches.clear()
    server.is_stopped = False
    went_on_ns = server.time_ns()
    array = node.until(" were lost", stream="error")
    assert int(values(array["stream"])["lost"]) > 100
    assert stamp_ns(wrenches[0]) > went_on_ns - 20e6, "nothing old"
    node.until(**HEALTHY)


@pytest.mark.long
def test_from_poses_to_the_force_of_the_environment(tmp_path: Path) -> None:
    """Identification and compensation as a user does them; the accelerometer is the only source."""
    server = WholeServer(SensorOptions(signal="poses"))
    with Node(server, **{"identify.file": tmp_path / "payload.yaml"}) as node:
        node.run(0.1)
        node.do("identify/start")
        taken = 0
        while taken < 6:
            done, text = node.trigger("identify/add_pose")
            if done:
                taken += 1
                node.run(3.0)  # until it has begun to turn to the next
            else:
                assert any(words in text for words in ("stationary", "turns")), text
        node.do("identify/solve")
        node.do("identify/apply")
        mass, center = node.parameters("tool_mass", "tool_center_of_gravity")
        assert mass == pytest.approx(TOOL_MASS, rel=0.01)
        assert list(center) == pytest.approx(TOOL_CENTRE, abs=0.002)
        server.simulation.command("signal turn")
        wrenches = node.hear("wrench_compensated")
        node.run(2.0)
        wrenches.clear()
        node.run(5.0)
        node.until("subtracted: bias, weight and inertia of the tool", compensation="ok")
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
        arrays = listener.subscribe(DiagnosticArray, "diagnostics")
        wrenches = listener.subscribe(WrenchStamped, "wrench", depth=20)
        assert six(wrenches.get(timeout=PATIENCE_S)) == pytest.approx(CONSTANT)
        array: dict[str, Any] = {}
        while not array or {level(array["link"]), level(array["sensor"])} != {"ok"}:
            statuses = arrays.get(timeout=PATIENCE_S).status
            array = {status.name.rpartition(" ")[2]: status for status in statuses}
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
