"""/diagnostics: the judgement of all that can be wrong, and what is published of it in simulated time."""

from __future__ import annotations

import functools
import operator
from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from bota_ethercat.framing import DataFlag
from bota_ethercat.health.verdict import LIMITS, Level
from bota_ethercat.pdo import encode
from bota_ethercat.sensor.warnings_register import WARNINGS, Severity
from bridge.diagnostics import CompensationState, Snapshot, Status, judge, text_of
from bridge.stream.link import SensorInfo
from bridge.stream.reader import Flags
from tests.bridge.simulated_node import HEALTHY, SETTINGS, Node, Server, level, status, values

LINK: dict[str, Any] = {
    "sensor": 0, "address": "localhost:1", "is_connected": True, "is_reachable": True, "problem": "",
    "info": SensorInfo(0, "name", "7", "OP"), "lost": None, "rate_hz": 800.0, "settings": {}, "delay_ms": {},
}  # fmt: skip
GOOD: dict[str, Any] = {
    "connection_s": 5.0, "silent_s": 0.0, "rate_hz": 800.0, "age_us": (100.0, 300.0),
    "counts": Counter(connects=1), "new": Counter(), "flags": Flags(), "temperature": 30.0,
    "server": {"sensors": [{"clock": {"mode": "locked"}}]}, "answer_s": 0.0,
}  # fmt: skip
FULL = CompensationState(good="subtracted: all", follows_imu=True)


def statuses(link: dict[str, Any] | None = None, **changes: Any) -> dict[str, Status]:
    known: Any = SimpleNamespace(**LINK | (link or {}))
    return {status.name: status for status in judge(Snapshot(known, **GOOD | changes), LIMITS)}


def test_good_is_good_and_the_worst_comes_first() -> None:
    assert [status.level for status in statuses().values()] == [Level.GOOD] * 5
    assert statuses()["stream"].message == "800 samples a second"
    status = statuses(flags=Flags(warnings=0x61))["sensor"]
    assert status.level == Level.TROUBLE
    assert status.message.index("saturated") < status.message.index("Overtemperature")
    assert [text_of(v) for v in (True, 1.5, "a\x1bb", "")] == ["true", "1.5", "a?b", ""]


@pytest.mark.parametrize(
    ("name", "level", "words", "changes"),
    [
        ("link", Level.TROUBLE, "no server at localhost:1: gone; start ethercat-server",
         {"link": {"is_connected": False, "problem": "gone", "is_reachable": False}}),
        ("link", Level.TROUBLE, "not connected to localhost:1: it has no sensor 3 (the node keeps trying)",
         {"link": {"is_connected": False, "problem": "it has no sensor 3"}}),
        *((name, Level.NOT_POSSIBLE, f"see {where}", {"link": {"is_connected": False}}) for name, where in
          (("stream", "link"), ("sensor", "link"), ("clock", "stream"), ("compensation", "stream"))),
        ("link", Level.LOOK, "has not answered for 3 s", {"answer_s": 3.0}),
        ("link", Level.LOOK, "again", {"counts": Counter(connects=2), "new": Counter(connects=1)}),
        ("compensation", Level.TROUBLE, "has stopped: why",
         {"compensation": CompensationState(stopped="has stopped: why")}),
        ("compensation", Level.LOOK, "3 samples were not compensated: why",
         {"new": Counter(uncompensated=3), "compensation": CompensationState(why_withheld="why")}),
        ("compensation", Level.LOOK, "the IMU's range was exceeded",
         {"flags": Flags(acceleration_saturated=4), "compensation": FULL}),
        ("compensation", Level.LOOK, "not kept", {"compensation": CompensationState(doubtful="not kept")}),
        ("compensation", Level.GOOD, "subtracted: all", {"compensation": FULL}),
        ("stream", Level.TROUBLE, "server does not answer: it is stopped", {"silent_s": 2.0, "answer_s": 1.5}),
        ("stream", Level.TROUBLE, "in state SAFEOP",
         {"silent_s": 2.0, "link": {"info": SensorInfo(0, "", "", "SAFEOP")}}),
        ("stream", Level.TROUBLE, "does not answer the bus", {"silent_s": 2.0, "new": Counter(invalid=1)}),
        ("stream", Level.LOOK, "4 of 804", {"new": Counter(samples=800, server_lost_samples=4)}),
        ("stream", Level.LOOK, "1 frame was invalid", {"new": Counter(samples=799, invalid=1)}),
        ("stream", Level.LOOK, "has it back: the server's computer stood still",
         {"new": Counter(server_recoveries=1, server_missed_deadlines=24)}),
        ("stream", Level.LOOK, "5 old samples skipped", {"new": Counter(stale=5)}),
        ("sensor", Level.TROUBLE, "no power; check its cable", {"link": {"lost": "no power"}}),
        ("clock", Level.NOT_POSSIBLE, "not said", {"server": {}}),
        ("clock", Level.NOT_POSSIBLE, "not said", {"server": {"sensors": 5, "last_10s": [], "uptime_s": {}}}),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said(name: str, level: Level, words: str, changes: dict[str, Any]) -> None:
    status = statuses(**changes)[name]
    assert status.level == level
    assert words in status.message


@pytest.mark.parametrize(
    ("code", "ago_s", "level"),
    [(0x4210, 3.0, Level.LOOK), (0x4210, 90.0, Level.GOOD), (0x0000, 3.0, Level.GOOD)],
)
def test_the_last_emergency_is_a_warning_for_a_minute(code: int, ago_s: float, level: Level) -> None:
    last = {"code": code, "text": "temper\x1bature", "register": 9, "data": "00", "ago_s": ago_s}
    clock = {"mode": "locked"}
    status = statuses(server={"sensors": [{"clock": clock, "emergencies": 7, "emergency": last}]})["sensor"]
    assert status.level == level
    assert ("Emergency 0x4210 (temper?ature): if it" in status.message) == (level is Level.LOOK)
    assert status.values["last_emergency"] == f"emergency 0x{code:04X} (temper?ature)"
    assert (status.values["emergencies"], status.values["last_emergency_ago_s"]) == (7, ago_s)


@pytest.mark.parametrize("last", [5, [], {}, {"code": "x", "ago_s": 1}, {"code": 0x4210, "ago_s": "now"}])
def test_an_emergency_that_makes_no_sense_is_none(last: object) -> None:
    assert statuses(server={"sensors": [{"emergency": last}]})["sensor"].level == Level.GOOD


@pytest.mark.parametrize("row", WARNINGS, ids=lambda row: str(row.flag))
def test_each_bit_has_its_level_and_remedy(row: Any) -> None:
    status = statuses(flags=Flags(warnings=row.flag))["sensor"]
    assert status.level == (Level.LOOK if row.severity is Severity.WARNING else Level.TROUBLE)
    assert row.meaning in status.message
    assert status.message.lower().endswith(f": {row.remedy.lower()}")


# In the node.


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


def test_it_is_published_every_second_and_at_once_when_a_level_changes(node: Node, server: Server) -> None:
    arrays = node.hear("/diagnostics")
    assert len(node.fresh(arrays, 5.0)) in (4, 5)
    node.statuses()
    arrays.clear()
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "no power"})
    node.run(0.2)
    assert len(arrays) == 1


def test_warning_bits_of_one_frame_each_are_told_once(node: Node, server: Server) -> None:
    for row in WARNINGS:
        server.once(process_data=encode(61, {"warnings": row.flag}))
    told = []

    def all_are_told() -> bool:
        told.append(node.statuses()["sensor"])
        return all(any(row.meaning in one.message for one in told) for row in WARNINGS)

    node.run_until(all_are_told, "each bit")
    registers = [int(values(one)["warnings_register"], 16) for one in told]
    assert functools.reduce(operator.or_, registers) == 0x7F
    assert "error" in [level(one) for one in told]
    assert node.until(sensor="ok")["sensor"].message == "as it should be"


def test_saturation_and_heat(node: Node, server: Server) -> None:
    for _ in range(3):
        server.once(process_data=encode(61, {"force_torque_saturated": 0b101}))
    array = node.until("Force/torque (ADC) saturated: Fx, Fz", sensor="error")
    assert values(array["sensor"])["saturated_samples"] == "3"
    node.until(sensor="ok")
    server.changes = {"process_data": encode(61, {"temperature": 85.0})}
    node.until("85.0 °C", sensor="error")


def test_lost_samples_are_counted(node: Node, server: Server) -> None:
    server.sequence += 7
    server.once(flags=DataFlag.GAP)
    node.until("7 of ", " were lost", stream="error")
    node.until(**HEALTHY)
    server.answers["status"] = lambda _: status(lost_samples=11)
    array = node.until("11 of ", " were lost", stream="error")
    assert values(array["stream"])["server_lost"] == "11"


def test_a_change_says_the_rate_that_its_settings_do_not(node: Node, server: Server) -> None:
    server.answers["describe"] = lambda _: None
    for settings, rate_hz in ((SETTINGS, 50), ({**SETTINGS, "chop": True}, None), (SETTINGS, "fast")):
        message = {"event": "reconfigured", "sensor": 0, "settings": settings, "rate_hz": rate_hz}
        server.send_json(message)
        node.run(0.1)
        assert node.node.reader.link.rate_hz == 50


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


def test_what_is_skipped_and_what_is_repeated(node: Node, server: Server) -> None:
    # As after the node was stopped: a burst, then the newest.
    for number in range(20):
        server.send_sample(0.0, monotonic_ns=server.monotonic_ns() - 10**9 + number)
    array = node.until("20 old samples skipped", stream="warn")
    assert int(values(array["stream"])["skipped"]) == 20
    server.changes = {"flags": DataFlag.REPEATED}
    node.until("the same sample again and again", stream="error", sensor="stale", clock="stale")


def test_a_lost_sensor(node: Node, server: Server) -> None:
    server.send_json({"event": "sensor_lost", "sensor": 1, "message": "another one"})
    node.run(1.0)
    assert level(node.statuses()["sensor"]) == "ok"
    server.changes = {"flags": DataFlag.INVALID}
    server.send_json({"event": "sensor_lost", "sensor": 0, "message": "sensor 0 is lost: no power"})
    array = node.until("sensor 0 is lost: no power", sensor="error", stream="error", clock="stale")
    assert array["sensor"].message.startswith("sensor 0 is lost: no power")
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


def test_a_server_that_is_gone_and_comes_back(node: Node, server: Server) -> None:
    server.listens = False
    server.drop()
    words = ("no server at localhost:12001", "start ethercat-server")
    array = node.until(*words, link="error", stream="stale", sensor="stale", clock="stale")
    assert values(array["link"])["connected"] == "false"
    server.listens = True
    array = node.until("was interrupted", link="warn")
    link = values(array["link"])
    assert (link["reconnects"], link["server_uptime_s"]) == ("1", ""), (
        "what the other server said is of the other"
    )
    node.until(**HEALTHY)
