"""The judgement: each thing that can be wrong, its level and its words; hostile replies are survived."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bota_ethercat.framing import DataMessage
from bota_ethercat.health.verdict import LIMITS, Level
from bota_ethercat.pdo import encode
from bota_ethercat.sensor.warnings_register import WARNINGS, Severity
from bridge.diagnostics.health import Status, judge, text_of
from bridge.diagnostics.observer import CompensationState, Counts, Snapshot
from bridge.stream.link import SensorInfo
from bridge.stream.watch import Flags, Watch
from tests.compensation.making import BIAS, TOOL

pytestmark = pytest.mark.ros
SAFEOP = SensorInfo(0, "", "", "", "SAFEOP")
GOOD = Snapshot(
    sensor=0, address="localhost:1", connected=True, problem="", is_reachable=True,
    connection_s=5.0,
    info=SensorInfo(0, "name", "7", "800", "OP"), lost=None, silent_s=0.0, rate_hz=800.0, expected_hz=800.0,
    age_us=(100.0, 300.0), counts=Counts(connects=1), new=Counts(),
    flags=Flags(), temperature=30.0, server={"sensors": [{"clock": {"mode": "locked"}}]},
    answer_s=0.0,
)  # fmt: skip


STOPPED = CompensationState(has_subscribers=True, why_stopped="why")
FULL = CompensationState(has_subscribers=True, payload=TOOL, source="imu", bias=BIAS)


def statuses(**changes: Any) -> dict[str, Status]:
    return {status.name: status for status in judge(GOOD._replace(**changes), LIMITS)}


def test_good_is_good() -> None:
    assert [status.level for status in statuses().values()] == [Level.GOOD] * 5
    assert statuses()["stream"].message == "800 samples a second"


@pytest.mark.parametrize(
    ("name", "level", "words", "changes"),
    [
        (
            "link",
            Level.TROUBLE,
            "no server at localhost:1: gone; start ethercat-server",
            {"connected": False, "problem": "gone", "is_reachable": False},
        ),
        (
            "link",
            Level.TROUBLE,
            "not connected to localhost:1: it has no sensor 3 (the node keeps trying)",
            {"connected": False, "problem": "it has no sensor 3"},
        ),
        ("stream", Level.NOT_POSSIBLE, "see link", {"connected": False}),
        ("sensor", Level.NOT_POSSIBLE, "see link", {"connected": False}),
        ("clock", Level.NOT_POSSIBLE, "see stream", {"connected": False}),
        ("link", Level.LOOK, "has not answered for 3 s", {"answer_s": 3.0}),
        ("compensation", Level.NOT_POSSIBLE, "see stream", {"connected": False}),
        ("compensation", Level.TROUBLE, "has stopped: why", {"compensation": STOPPED}),
        ("compensation", Level.TROUBLE, "could not be published if somebody subscribed: why",
         {"compensation": STOPPED._replace(has_subscribers=False)}),
        ("sensor", Level.TROUBLE, "are counts", {"settings": {"calibration_matrix": False}}),
        ("sensor", Level.LOOK, "correct the URDF", {"settings": {"coordinate_system": True}}),
        ("sensor", Level.GOOD, "as it should be", {"settings": {"coordinate_system": False}}),
        ("compensation", Level.LOOK, "3 samples were not compensated while the sensor",
         {"new": Counts(uncompensated=3)}),
        ("compensation", Level.LOOK, "3 samples were not compensated, for lack of a current orientation",
         {"new": Counts(uncompensated=3), "compensation": FULL}),
        ("compensation", Level.LOOK, "the IMU's range was exceeded",
         {"flags": Flags(acceleration_saturated=4), "compensation": FULL}),
        ("compensation", Level.LOOK, "not kept", {"compensation": CompensationState(problem="not kept")}),
        ("compensation", Level.GOOD, "bias, weight and inertia", {"compensation": FULL}),
        ("compensation", Level.GOOD, "subtracted: bias;", {"compensation": CompensationState(bias=BIAS)}),
        ("link", Level.LOOK, "again", {"counts": Counts(connects=2), "new": Counts(connects=1)}),
        ("stream", Level.TROUBLE, "No new sample for 0.6 s", {"silent_s": 0.6}),
        ("stream", Level.TROUBLE, "server does not answer: it is stopped",
         {"silent_s": 2.0, "answer_s": 1.5}),
        ("stream", Level.TROUBLE, "in state SAFEOP", {"silent_s": 2.0, "info": SAFEOP}),
        ("stream", Level.TROUBLE, "again and again", {"silent_s": 2.0, "new": Counts(repeated=1)}),
        ("stream", Level.TROUBLE, "does not answer the bus",
         {"silent_s": 2.0, "new": Counts(invalid=1)}),
        ("stream", Level.LOOK, "700 samples a second instead of 800: the filters", {"rate_hz": 700.0}),
        ("stream", Level.GOOD, "798", {"rate_hz": 798.0}),
        ("stream", Level.LOOK, "12.0 ms old", {"age_us": (1.0, 12_000.0)}),
        ("stream", Level.TROUBLE, "120.0 ms old", {"age_us": (1.0, 120_000.0)}),
        ("stream", Level.TROUBLE, "600 samples a second", {"rate_hz": 600.0}),
        ("stream", Level.LOOK, "3 of 803 samples (0.37 %) were lost", {"new": Counts(samples=800, lost=3)}),
        ("stream", Level.LOOK, "4 of 804", {"new": Counts(samples=800, server_lost_samples=4)}),
        ("stream", Level.TROUBLE, "50 of 800", {"new": Counts(samples=750, lost=50), "rate_hz": 750.0}),
        ("stream", Level.LOOK, "1 frame was invalid", {"new": Counts(samples=799, invalid=1)}),
        ("stream", Level.LOOK, "has it back", {"new": Counts(server_recoveries=1)}),
        ("stream", Level.LOOK, "has it back: the server's computer stood still",
         {"new": Counts(server_recoveries=1, server_missed_deadlines=24)}),
        ("stream", Level.LOOK, "5 old samples skipped", {"new": Counts(stale=5)}),
        ("stream", Level.TROUBLE, "not finite: power-cycle", {"new": Counts(not_finite=1)}),
        ("stream", Level.TROUBLE, "not finite", {"new": Counts(server_not_finite=2)}),
        ("sensor", Level.TROUBLE, "no power; check its cable", {"lost": "no power"}),
        ("sensor", Level.NOT_POSSIBLE, "see stream", {"silent_s": 2.0}),
        ("sensor", Level.TROUBLE, "saturated: Fy: reduce", {"flags": Flags(0, 0, 2)}),
        ("sensor", Level.LOOK, "61.0 °C", {"temperature": 61.0}),
        ("sensor", Level.TROUBLE, "81.0 °C", {"temperature": 81.0}),
        ("clock", Level.NOT_POSSIBLE, "not said", {"server": {}}),
        ("clock", Level.LOOK, "not follow", {"server": {"sensors": [{"clock": {"mode": "oversampling"}}]}}),
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


def test_the_worst_comes_first() -> None:
    status = statuses(flags=Flags(warnings=0x61))["sensor"]
    assert status.level == Level.TROUBLE
    assert status.message.index("saturated") < status.message.index("Overtemperature")


def test_values_are_printable_text() -> None:
    assert [text_of(v) for v in (True, 1.5, "a\x1bb", "")] == ["true", "1.5", "a?b", ""]


def test_flags_of_one_frame_are_kept_until_taken() -> None:
    watch = Watch()

    def see(**fields: float) -> None:
        watch.see([DataMessage(1, 0, 0, 0, 0, 3, encode(61, fields))])

    see(warnings=1, status=2)
    see(warnings=4, force_torque_saturated=8)
    see()
    assert watch.take_flags() == (2, 5, 8, 0, 0)
    assert watch.take_flags() == (0, 0, 0, 0, 0)
    see(warnings=32)
    assert [watch.take_flags().warnings for _ in range(2)] == [32, 32]  # it is still set
