"""/diagnostics: what it says of a healthy stream and of what can be wrong. One node for all tests."""

from __future__ import annotations

import functools
import operator
import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from protocol.framing import DataFlag
from protocol.pdo import encode
from protocol.sensor.warnings_register import WARNINGS
from tests.bridge.conftest import Listener, NodeThread, starter, wait_until
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.shared import listener, server, stream
from tests.bridge.streaming import Diagnostics, Stream, status, streaming_description, values

__all__ = ["listener", "server", "stream"]
pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
HEALTHY = {"link": OK, "stream": OK, "sensor": OK, "clock": OK, "compensation": OK}


@pytest.fixture(scope="module")
def node(server: ScriptedServer, stream: Stream, listener: Listener) -> Iterator[NodeThread]:
    with starter(listener) as start:
        # This machine may be busy: ages are judged in test_health.
        yield start(server.port, **{"diagnostics.age_warn": 1.0, "diagnostics.rate_tolerance": 0.2})


@pytest.fixture(scope="module")
def _diagnostics(listener: Listener, node: NodeThread) -> Diagnostics:
    return Diagnostics(listener)


@pytest.fixture
def diagnostics(_diagnostics: Diagnostics, node: NodeThread) -> Iterator[Diagnostics]:
    _diagnostics.until(**HEALTHY)
    yield _diagnostics
    assert node.is_running
    assert "Traceback" not in node.log


def test_a_healthy_stream(diagnostics: Diagnostics) -> None:
    diagnostics.until(**HEALTHY)
    array = diagnostics.next()
    assert set(array) == set(HEALTHY)
    assert {item.hardware_id for item in array.values()} == {"BFT-SENS-ECAT-M8 1"}
    link, stream, sensor, clock, compensation = (values(array[name]) for name in HEALTHY)
    assert (link["connected"], link["reconnects"]) == ("true", "0")
    assert link["address"].startswith("localhost:")
    assert 80 < float(stream["rate_hz"]) < 120
    assert stream["expected_hz"] == "100.0"
    assert 0 < float(stream["age_p50_us"]) <= float(stream["age_p99_us"])
    for key in ("lost", "skipped", "repeated", "invalid", "server_lost", "server_late_p99_us"):
        assert stream[key].replace(".", "").isdigit(), key
    assert (sensor["serial"], sensor["al_state"]) == ("1", "OP")
    assert (clock["mode"], clock["uncertainty_us"]) == ("locked", "5.0")
    assert array["compensation"].message == (
        "nothing is subtracted: there is no bias and no tool_mass; nobody has subscribed"
    )
    assert (compensation["tared"], compensation["orientation_source"]) == ("false", "accelerometer")


def test_warning_bits_of_one_frame_each_are_told_once(diagnostics: Diagnostics, stream: Stream) -> None:
    for row in WARNINGS:
        stream.once(process_data=encode(61, {"warnings": row.flag}))
    told = []

    def all_are_told() -> bool:
        told.append(diagnostics.next()["sensor"])
        return all(any(f"{row.meaning}: {row.remedy}" in one.message for one in told) for row in WARNINGS)

    wait_until(all_are_told, "each bit")
    registers = [int(values(one)["warnings_register"], 16) for one in told]
    assert functools.reduce(operator.or_, registers) == 0x7F
    assert max(one.level[0] for one in told) == ERROR
    assert diagnostics.until(sensor=OK)["sensor"].message == "as it should be"


def test_saturation_and_heat(diagnostics: Diagnostics, stream: Stream) -> None:
    stream.once(process_data=encode(61, {"force_torque_saturated": 0b101}))
    diagnostics.until("force torque saturated: axes 0x5", sensor=WARN)
    diagnostics.until(sensor=OK)
    stream.changes = {"process_data": encode(61, {"temperature": 85.0})}
    diagnostics.until("85.0 °C", sensor=ERROR)
    stream.changes = {}


def test_lost_samples_are_counted(diagnostics: Diagnostics, stream: Stream, server: ScriptedServer) -> None:
    server.sequence += 7
    stream.once(flags=DataFlag.GAP)
    diagnostics.until("7 samples lost", stream=WARN)
    diagnostics.until(**HEALTHY)
    server.answers["status"] = lambda _: status(lost_samples=11)
    array = diagnostics.until("11 samples lost", stream=WARN)
    assert values(array["stream"])["server_lost"] == "11"


def test_another_rate_than_expected(diagnostics: Diagnostics, stream: Stream, server: ScriptedServer) -> None:
    server.description["sensors"][0]["rate_hz"] = 200
    diagnostics.until("samples a second instead of 200", stream=WARN)
    server.description = streaming_description()


def test_a_sensor_that_repeats_itself(diagnostics: Diagnostics, stream: Stream) -> None:
    stream.changes = {"flags": DataFlag.REPEATED}
    diagnostics.until("the same sample again and again", stream=ERROR, sensor=STALE, clock=STALE)
    stream.changes = {}


def test_a_lost_sensor(diagnostics: Diagnostics, stream: Stream, server: ScriptedServer) -> None:
    server.send_json({"event": "sensor_lost", "sensor": 1, "message": "another one"})
    stream.changes = {"flags": DataFlag.INVALID}
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "sensor 0 is lost: no power"})
    array = diagnostics.until("sensor 0 is lost: no power", sensor=ERROR, stream=ERROR, clock=STALE)
    assert array["sensor"].message.startswith("sensor 0 is lost: no power")
    assert "sensor 0 is lost: no power" in array["stream"].message
    stream.changes = {}
    server.send_json({"event": "sensor_back", "sensor": 0})


def test_a_clock_that_is_not_followed(diagnostics: Diagnostics, server: ScriptedServer) -> None:
    server.answers["status"] = lambda _: status(mode="oversampling", lost_samples=11)
    diagnostics.until("oversampling", clock=WARN)
    server.answers["status"] = lambda _: status(lost_samples=11)


def test_a_server_that_does_not_answer(diagnostics: Diagnostics, server: ScriptedServer) -> None:
    owed: list[dict[str, object]] = []

    def keep(message: dict[str, object]) -> None:
        owed.append(message)

    answer = server.answers["status"]
    server.answers["status"] = keep
    diagnostics.until("has not answered", link=WARN, stream=OK)  # samples come all the same
    assert len(owed) == 1  # it is not asked again before it has answered
    server.answers["status"] = answer
    server.send_json({"reply": "status", "id": owed[0]["id"], **status()})


def test_a_server_that_is_gone_and_comes_back(
    diagnostics: Diagnostics, stream: Stream, server: ScriptedServer
) -> None:
    stream.paused = True
    server.description = {**streaming_description(), "sensors": []}
    server.drop()
    words = ("no server at localhost:", "start ethercat-server")
    array = diagnostics.until(*words, link=ERROR, stream=STALE, sensor=STALE, clock=STALE)
    assert values(array["link"])["connected"] == "false"
    server.description = streaming_description()
    stream.paused = False
    array = diagnostics.until(**HEALTHY)
    assert values(array["link"])["reconnects"] == "1"


def test_old_samples_are_skipped(diagnostics: Diagnostics, stream: Stream) -> None:
    """As after the node was stopped: test_stream stops one for real."""
    for _ in range(20):
        stream.once(monotonic_ns=time.monotonic_ns() - 10**9)
    array = diagnostics.until("old samples skipped", stream=WARN)
    wait_until(lambda: int(values(diagnostics.next()["stream"])["skipped"]) >= 20, "all of them counted")
    assert int(values(array["stream"])["skipped"]) > 0
