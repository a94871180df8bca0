"""/diagnostics in simulated time: what it says of a healthy stream and of what can be wrong."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import encode
from bota_ethercat.sensor.warnings_register import WARNINGS
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer
from tests.bridge.streaming import SETTINGS, status, values

pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
HEALTHY = {"link": OK, "stream": OK, "sensor": OK, "clock": OK, "compensation": OK}


@pytest.fixture
def server() -> SimulatedServer:
    return SimulatedServer()


@pytest.fixture
def node(_ros: None, server: SimulatedServer) -> Iterator[SimulatedNode]:
    with SimulatedNode(server) as started:
        started.until(**HEALTHY)
        yield started


def test_a_healthy_stream(node: SimulatedNode) -> None:
    node.run(3.0)
    array = node.statuses()
    assert [item.level[0] for item in array.values()] == [OK] * 5
    assert set(array) == set(HEALTHY)
    assert {item.hardware_id for item in array.values()} == {"BFT-SENS-ECAT-M8 1"}
    link, stream, sensor, clock, compensation = (values(array[name]) for name in HEALTHY)
    assert (link["connected"], link["reconnects"]) == ("true", "0")
    assert link["address"] == "localhost:12001"
    assert (stream["rate_hz"], stream["expected_hz"]) == ("100.0", "100.0")
    assert (stream["age_p50_us"], stream["age_p99_us"]) == ("0", "0")
    for key in ("lost", "skipped", "repeated", "invalid", "server_lost", "server_late_p99_us"):
        assert stream[key].replace(".", "").isdigit(), key
    assert (sensor["serial"], sensor["al_state"]) == ("1", "OP")
    assert (clock["mode"], clock["uncertainty_us"]) == ("locked", "5.0")
    assert array["compensation"].message == (
        "nothing is subtracted: there is no bias and no tool_mass; nobody has subscribed"
    )
    assert (compensation["tared"], compensation["gravity_source"]) == ("false", "imu")


def test_it_is_published_every_second_and_at_once_when_a_level_changes(
    node: SimulatedNode, server: SimulatedServer
) -> None:
    arrays = node.hear("/diagnostics")
    arrays.clear()
    node.run(5.0)
    assert len(arrays) in (4, 5)
    node.statuses()
    arrays.clear()
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "no power"})
    node.run(0.2)
    assert len(arrays) == 1


def test_warning_bits_of_one_frame_each_are_told_once(node: SimulatedNode, server: SimulatedServer) -> None:
    for row in WARNINGS:
        server.once(process_data=encode(61, {"warnings": row.flag}))
    told = []

    def all_are_told() -> bool:
        told.append(node.statuses()["sensor"])
        return all(any(row.meaning in one.message for one in told) for row in WARNINGS)

    node.run_until(all_are_told, "each bit")
    registers = [int(values(one)["warnings_register"], 16) for one in told]
    assert functools.reduce(operator.or_, registers) == 0x7F
    assert max(one.level[0] for one in told) == ERROR
    assert node.until(sensor=OK)["sensor"].message == "as it should be"


def test_saturation_and_heat(node: SimulatedNode, server: SimulatedServer) -> None:
    for _ in range(3):
        server.once(process_data=encode(61, {"force_torque_saturated": 0b101}))
    array = node.until("Force/torque (ADC) saturated: Fx, Fz", sensor=ERROR)
    assert values(array["sensor"])["saturated_samples"] == "3"
    node.until(sensor=OK)
    server.changes = {"process_data": encode(61, {"temperature": 85.0})}
    node.until("85.0 °C", sensor=ERROR)


def test_lost_samples_are_counted(node: SimulatedNode, server: SimulatedServer) -> None:
    server.sequence += 7
    server.once(flags=DataFlag.GAP)
    node.until("7 of ", " were lost", stream=ERROR)
    node.until(**HEALTHY)
    server.answers["status"] = lambda _: status(lost_samples=11)
    array = node.until("11 of ", " were lost", stream=ERROR)
    assert values(array["stream"])["server_lost"] == "11"


def test_a_change_says_the_rate_that_its_settings_do_not(
    node: SimulatedNode, server: SimulatedServer
) -> None:
    server.answers["describe"] = lambda _: None
    for settings, rate_hz in ((SETTINGS, 50), ({**SETTINGS, "chop": True}, None), (SETTINGS, "fast")):
        message = {"event": "reconfigured", "sensor": 0, "settings": settings, "rate_hz": rate_hz}
        server.send_json(message)
        node.run(0.1)
        assert node.node.reader.link.rate_hz == 50


def test_what_is_wrong_with_the_stream(node: SimulatedNode, server: SimulatedServer) -> None:
    answer = status(mode="oversampling")
    answer["sensors"][0]["not_finite"] = 3
    server.answers["status"] = lambda _: answer
    array = node.until("values that are not finite", "does not follow", stream=ERROR, clock=WARN)
    assert values(array["stream"])["server_not_finite"] == "3"
    server.answers["status"] = lambda _: status()
    node.until(**HEALTHY)
    server.ahead_ns = -12_000_000
    node.until("Samples are 12.0 ms old on arrival (p99)", stream=WARN)
    server.description["sensors"][0]["rate_hz"] = 200
    node.until("100 samples a second instead of 200", stream=ERROR)


def test_a_sensor_that_repeats_itself(node: SimulatedNode, server: SimulatedServer) -> None:
    server.changes = {"flags": DataFlag.REPEATED}
    node.until("the same sample again and again", stream=ERROR, sensor=STALE, clock=STALE)


def test_a_lost_sensor(node: SimulatedNode, server: SimulatedServer) -> None:
    server.send_json({"event": "sensor_lost", "sensor": 1, "message": "another one"})
    node.run(1.0)
    assert node.statuses()["sensor"].level[0] == OK
    server.changes = {"flags": DataFlag.INVALID}
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "sensor 0 is lost: no power"})
    array = node.until("sensor 0 is lost: no power", sensor=ERROR, stream=ERROR, clock=STALE)
    assert array["sensor"].message.startswith("sensor 0 is lost: no power")
    assert array["stream"].message == "The server has lost the sensor: check its cable and power"
    server.changes = {}
    server.send_json({"event": "sensor_back", "sensor": 0})
    node.until(**HEALTHY)


def test_a_server_that_does_not_answer(node: SimulatedNode, server: SimulatedServer) -> None:
    owed: list[dict[str, object]] = []
    answer, server.answers["status"] = server.answers["status"], owed.append
    node.until("has not answered", link=WARN, stream=OK)  # samples come all the same
    assert len(owed) == 1  # it is not asked again before it has answered
    server.answers["status"] = answer
    server.send_json({"reply": "status", "id": owed[0]["id"], **status()})
    node.until(**HEALTHY)


def test_a_server_that_is_gone_and_comes_back(node: SimulatedNode, server: SimulatedServer) -> None:
    server.listens = False
    server.drop()
    words = ("no server at localhost:12001", "start ethercat-server")
    array = node.until(*words, link=ERROR, stream=STALE, sensor=STALE, clock=STALE)
    assert values(array["link"])["connected"] == "false"
    server.listens = True
    array = node.until("was interrupted", link=WARN)
    assert values(array["link"])["reconnects"] == "1"
    node.until(**HEALTHY)


def test_old_samples_are_skipped(node: SimulatedNode, server: SimulatedServer) -> None:
    """As after the node was stopped: a burst, then the newest."""
    for number in range(20):
        server.send_sample(0.0, monotonic_ns=server.monotonic_ns() - 10**9 + number)
    array = node.until("20 old samples skipped", stream=WARN)
    assert int(values(array["stream"])["skipped"]) == 20
