"""/diagnostics, in simulated time: what is said of all that can be wrong, and when. Verdicts: test_health."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy

from bota_ethercat.framing import DataFlag
from bota_ethercat.pdo import encode
from bota_ethercat_bridge.diagnostics import text_of
from tests.bridge.real_node import retire
from tests.bridge.simulated_node import HEALTHY, Node, Server, level, status, values
from tests.compensation.making import written_parameters
from tests.server.running import wait_until


@pytest.fixture
def server() -> Server:
    return Server()


@pytest.fixture
def node(server: Server) -> Iterator[Node]:
    with Node(server) as started:
        started.until(**HEALTHY)
        yield started


def test_a_healthy_stream(node: Node) -> None:
    node.run(3.0)
    array = node.statuses()
    assert [level(item) for item in array.values()] == ["ok"] * 5
    assert set(array) == set(HEALTHY)
    assert {item.hardware_id for item in array.values()} == {"BFT-SENS-ECAT-M8 100"}
    link, stream, sensor, clock, compensation = (values(array[name]) for name in HEALTHY)
    assert (link["connected"], link["reconnects"]) == ("true", "0")
    assert link["address"] == "localhost:12001"
    assert (stream["rate_hz"], stream["expected_hz"]) == ("100.0", "100.0")
    assert (stream["age_p50_us"], stream["age_p99_us"]) == ("0", "0")
    for key in ("lost", "skipped", "repeated", "invalid", "server_lost", "server_late_p99_us"):
        assert stream[key].replace(".", "").isdigit(), key
    assert (sensor["serial"], sensor["al_state"]) == ("100", "OP")
    assert (clock["mode"], clock["uncertainty_us"]) == ("locked", "5.0")
    assert [text_of(value) for value in (True, 1.5, "a\x1bb", "")] == ["true", "1.5", "a?b", ""]
    assert array["compensation"].message == (
        "nothing is subtracted: there is no bias and no tool_mass; nobody has subscribed"
    )
    assert (compensation["tared"], compensation["gravity_source"]) == ("false", "imu")


def test_the_analyzer_of_the_package_takes_the_statuses_of_every_node_and_no_others(node: Node) -> None:
    file = Path(__file__).parents[2] / "ros2_bridge/config/diagnostic_aggregator.yaml"
    parameters = written_parameters(file)
    analyzer = parameters.pop("force_torque")
    assert (parameters, analyzer.pop("type")) == (
        {"path": "Sensors"},
        "diagnostic_aggregator/GenericAnalyzer",
    )
    assert analyzer.keys() == {"path", "regex", "timeout"}
    (pattern,) = analyzer["regex"]
    names = [
        f"{space}{name}: {each}"
        for each in node.statuses()
        for space in ("", "left/")
        for name in ("bridge", "bota_ft_sensor")
    ]
    assert len(names) == 20
    assert all(
        re.fullmatch(pattern, name) for name in (*names, *(each.name for each in node._arrays[-1].status))
    )
    assert not any(re.fullmatch(pattern, name) for name in ("camera: link", "abridge: link", "bridge: other"))


def test_it_is_published_every_second_and_at_once_when_a_level_changes(node: Node, server: Server) -> None:
    arrays = node.hear("/diagnostics")
    assert len(node.fresh(arrays, 5.0)) in (4, 5)
    node.statuses()
    arrays.clear()
    server.paused = True
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "no power"})
    node.run(0.2)
    assert len(arrays) == 1


def test_saturation_warnings_and_heat(node: Node, server: Server) -> None:
    for _ in range(3):
        server.once(process_data=encode(61, {"force_torque_saturated": 0b101}))
    for warnings in (8, *(0,) * 15, 32):  # of one frame each, told together
        server.once(process_data=encode(61, {"warnings": warnings}))
    array = node.until("Force/torque (ADC) saturated: Fx, Fz", "out of sync", "Overtemp", sensor="error")
    told = values(array["sensor"])
    assert (told["saturated_samples"], told["warnings_register"]) == ("3", "0x00000028")
    node.until(sensor="ok")
    server.changes = {"process_data": encode(61, {"temperature": 85.0})}
    node.until("85.0 °C", sensor="error")


def test_another_node_with_the_same_topics_is_told_once(node: Node) -> None:
    topics = [node.name.replace("bridge", name) for name in ("wrench", "temperature")]
    other = rclpy.create_node("other", start_parameter_services=False)
    publishers = [other.create_publisher(node.topics[topic].msg_type, topic, 1) for topic in topics]
    wait_until(
        lambda: all(node.node.count_publishers(topic) == 2 for topic in topics), "the other publishers"
    )
    said = f"publishes {topics[0]} and 1 more too: give one of them a namespace"
    node.until(said, stream="warn")
    node.run(3.0)
    for publisher in publishers:
        other.destroy_publisher(publisher)
    wait_until(lambda: all(node.node.count_publishers(topic) == 1 for topic in topics), "that they are gone")
    node.until(**HEALTHY)
    assert node.log.count("another node") == 1
    retire(other)


def test_lost_samples_are_counted(node: Node, server: Server) -> None:
    server.sequence += 7
    server.once(flags=DataFlag.GAP)
    node.until("7 of ", " were lost", stream="error")
    node.until(**HEALTHY)
    server.answers["status"] = lambda _: status(lost_samples=11)
    array = node.until("11 of ", " were lost", stream="error")
    assert values(array["stream"])["server_lost"] == "11"


def test_what_is_wrong_with_the_stream(node: Node, server: Server) -> None:
    answer = status(mode="oversampling")
    answer["sensors"][0]["not_finite"] = 3
    server.answers["status"] = lambda _: answer
    array = node.until("values that are not finite", "does not follow", stream="error", clock="warn")
    assert values(array["stream"])["server_not_finite"] == "3"
    server.answers["status"] = lambda _: status()
    node.until(**HEALTHY)
    server.ahead_ns = -12_000_000
    node.until("Samples are 12.0 ms old on arrival (p99)", stream="warn")
    server.description["sensors"][0]["rate_hz"] = 200
    node.until("100 samples a second instead of 200", stream="error")
    server.changes = {"flags": DataFlag.INVALID}
    node.until("the sensor does not answer the bus", stream="error")
    node.run(3.0)
    assert node.log.count("No new sample for 0.6 s, the sensor does not answer the bus: check its cable") == 1


def test_what_is_skipped_and_what_is_repeated(node: Node, server: Server) -> None:
    # As after the node was stopped: a burst, then the newest.
    for number in range(20):
        server.send_sample(0.0, monotonic_ns=server.monotonic_ns() - 10**9 + number)
    array = node.until("20 old samples skipped", stream="warn")
    assert int(values(array["stream"])["skipped"]) == 20
    server.changes = {"flags": DataFlag.REPEATED}
    node.until("the same sample again and again", stream="error", sensor="stale", clock="stale")


def test_a_node_that_was_not_run_blames_itself(node: Node, server: Server) -> None:
    """Its monitor looks first. What it reads then is old, or was withheld; and the server goes on."""
    node.until(**HEALTHY)
    for _ in range(840):
        server.step()
    node.node.monitor.tick()
    assert "No new sample for 8.4 s, this computer did not run this program for 8.4 s: give it" in node.log
    assert node.latest()["link"].message == "connected to localhost:12001"
    array = node.until("old samples skipped, this computer did not run this program for", stream="warn")
    assert "server" not in array["stream"].message
    assert "sends none" not in node.log
    node.until(**HEALTHY)
    server.paused = True
    node.until("the server sends none: see its log", stream="error")
    server.paused = False
    node.until(**HEALTHY)


@pytest.mark.parametrize(
    ("code", "ago_s", "expected"), [(0x4210, 3.0, "warn"), (0x4210, 90.0, "ok"), (0x0000, 3.0, "ok")]
)
def test_the_last_emergency_is_a_warning_for_a_minute(
    node: Node, server: Server, code: int, ago_s: float, expected: str
) -> None:
    answer = status()
    last = {"code": code, "text": "temper\x1bature", "register": 9, "data": "00", "ago_s": ago_s}
    answer["sensors"][0].update(emergencies=7, emergency=last)
    server.answers["status"] = lambda _: answer
    node.run(2.0)
    sensor = node.statuses()["sensor"]
    assert level(sensor) == expected
    assert ("Emergency 0x4210 (temper?ature): if it" in sensor.message) == (expected == "warn")
    told = values(sensor)
    assert told["last_emergency"] == f"emergency 0x{code:04X} (temper?ature)"
    assert (told["emergencies"], told["last_emergency_ago_s"]) == ("7", str(ago_s))


def test_a_lost_sensor(node: Node, server: Server) -> None:
    server.send_json({"event": "sensor_lost", "sensor": 1, "message": "another one"})
    node.run(1.0)
    assert level(node.statuses()["sensor"]) == "ok"
    server.changes = {"flags": DataFlag.INVALID}
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "sensor 0 is lost: no power"})
    array = node.until(sensor="error", stream="error", clock="stale")
    assert array["sensor"].message == "sensor 0 is lost: no power; check its cable and power"
    assert array["stream"].message == "The server has lost the sensor: check its cable and power"
    server.changes = {}
    server.send_json({"event": "sensor_back", "sensor": 0})
    node.until(**HEALTHY)


def test_a_server_that_does_not_answer(node: Node, server: Server) -> None:
    owed: list[dict[str, object]] = []
    answer, server.answers["status"] = server.answers["status"], owed.append
    node.until("has not answered", link="warn", stream="ok")  # samples come all the same
    assert len(owed) == 1  # it is not asked again before it has answered
    server.answers["status"] = answer
    server.send_json({"reply": "status", "id": owed[0]["id"], **status()})
    node.until(**HEALTHY)
    server.answers["status"], server.paused = owed.append, True  # as if it were stopped
    node.until("No new sample for", "the server does not answer", stream="error", clock="stale")


def test_a_server_that_is_gone_and_comes_back(node: Node, server: Server) -> None:
    node.run(2.0)
    server.listens = False
    server.drop()
    words = ("no server at localhost:12001", "start ethercat-server")
    array = node.until(*words, link="error", stream="stale", sensor="stale", clock="stale")
    assert values(array["link"])["connected"] == "false"
    server.listens, sensors = True, server.description["sensors"]
    server.description["sensors"] = []
    node.until("not connected to the server at localhost:12001 (the server has no sensor 0", link="error")
    server.description["sensors"] = sensors
    server.answers["status"] = lambda _: status(lost_samples=500)
    array = node.until("was interrupted", link="warn")
    link = values(array["link"])
    assert (link["reconnects"], link["server_uptime_s"]) == ("1", ""), (
        "what the other server said is of the other"
    )
    arrays = node.hear("/diagnostics")
    assert not [array for array in node.fresh(arrays, 3.0) if "lost" in array.status[1].message], "by another"
    node.until(**HEALTHY)
