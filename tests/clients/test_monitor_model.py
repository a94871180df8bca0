"""What the monitor makes of frames, replies and events, without a server."""

from __future__ import annotations

import json
import math
import re
from functools import partial
from types import SimpleNamespace
from typing import cast
from unittest import mock

import pytest

from bota_clients.errors import RecordingError
from bota_clients.monitor.compensated import NewestCompensated
from bota_clients.monitor.model import Model, SensorView
from bota_clients.monitor.reader import MonitorReader
from bota_clients.monitor.screen import ViewOptions, render, table
from bota_clients.monitor.words import json_line, json_object, verdict
from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.control import Event
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.limits import LIMITS, Level
from bota_ethercat.pdo import STANDARD_GRAVITY, ImuUnits
from bota_ethercat.stream.timeline import Timeline
from tests.clients import monitor_states as made
from tests.clients.monitor_states import START_S, description, frame, now, status
from tests.json_schema import problems

REST = {"force.z": -8.0, "acceleration.z": 1.0, "temperature": 30.0}


@pytest.fixture
def model() -> Model:
    """Connected to a server with one sensor."""
    fresh = Model(made.ADDRESS)
    made.connect(fresh, description(), made.OWN_PEER, START_S)
    return fresh


def take(model: Model, *frames: DataMessage) -> SensorView:
    """Its state when these have come together."""
    at_s = now(frames[-1].sequence)
    model.add_frames(frames, at_s)
    return only(model, at_s)


def only(model: Model, at_s: float) -> SensorView:
    (sensor,) = model.state(at_s).sensors
    return sensor


def run(first: int, count: int, **values: float) -> list[DataMessage]:
    return [frame(k, {**REST, **values}) for k in range(first, first + count)]


def peaks(sensor: SensorView) -> list[tuple[float, ...]]:
    assert sensor.peaks is not None
    return [tuple(peak) for peak in sensor.peaks]


def texts(sensor: SensorView) -> list[str]:
    return [alert.text for alert in sensor.alerts]


def test_a_peak_of_one_sample_is_held(model: Model) -> None:
    spike = frame(20, {**REST, "force.x": 55.0, "torque.z": -3.0})
    sensor = take(model, *run(0, 20), spike, *run(21, 20))
    assert sensor.sample is not None
    assert sensor.sample.force == (0.0, 0.0, -8.0)
    assert peaks(sensor) == [(0, 55), (0, 0), (-8, -8), (0, 0), (0, 0), (-3, 0)]


def test_repeated_invalid_and_not_finite_values_hold_no_peak(model: Model) -> None:
    high = {**REST, "force.x": 99.0, "warnings": 0x7F}
    kinds = DataFlag.REPEATED, DataFlag.INVALID, DataFlag.INVALID | DataFlag.REPEATED
    bad = frame(4, {**REST, "force.z": math.nan}), frame(5, {**REST, "torque.x": math.inf})
    old = (frame(k, high, flags=f) for k, f in enumerate(kinds, start=1))
    sensor = take(model, frame(0, REST), *old, *bad)
    assert (sensor.samples, sensor.repeated, sensor.invalid) == (3, 1, 2)
    assert peaks(sensor) == [(0, 0), (0, 0), (-8, -8), (0, 0), (0, 0), (0, 0)]


@pytest.mark.parametrize("silent", [False, True])
def test_samples_that_did_not_come_make_no_jitter(model: Model, silent: bool) -> None:
    steady = [frame(k)._replace(monotonic_ns=10**12 + k * made.PERIOD_NS) for k in range(100)]
    if silent:
        steady[50:60] = [each._replace(flags=DataFlag.REPEATED) for each in steady[50:60]]
    else:
        steady[50:61] = [steady[60]._replace(flags=DataFlag.GAP)]
    sensor = take(model, *steady)
    assert (sensor.missed, sensor.gaps, sensor.repeated) == ((0, 0, 10) if silent else (10, 1, 0))
    assert (sensor.jitter_us, sensor.jitter_worst_us) == (0, 0)
    shifts = [10**12 + k * made.PERIOD_NS + 50_000 * (k % 2) for k in range(8200)]
    uneven = [frame(k)._replace(monotonic_ns=shifts[k]) for k in range(4100, 8200)]
    sensor = take(model, *uneven)
    assert (sensor.jitter_us, sensor.jitter_worst_us) == pytest.approx((50, 50), abs=0.1)


def test_another_rate_is_no_jitter(model: Model) -> None:
    take(model, *(frame(k)._replace(monotonic_ns=10**12 + k * made.PERIOD_NS) for k in range(100)))
    other = description()
    other["sensors"][0]["rate_hz"] /= 2
    made.describe(model, other, now(100))
    slow = [frame(k)._replace(monotonic_ns=10**12 + (2 * k - 99) * made.PERIOD_NS) for k in range(100, 200)]
    sensor = take(model, *slow)
    assert (sensor.missed, sensor.jitter_us, sensor.jitter_worst_us) == (0, 0, 0)


def test_the_rate_is_that_of_the_samples_and_falls_when_they_stop(model: Model) -> None:
    for first in range(0, 1600, 40):
        take(model, *run(first, 40))
    assert only(model, now(1600)).rate_hz == pytest.approx(800, abs=0.5)
    assert 300 < (only(model, now(1600) + 2).rate_hz or 0) < 500
    assert only(model, now(1600) + 60).rate_hz == 0


def test_a_new_connection_is_no_loss_and_keeps_the_peaks_of_the_same_sensor(model: Model) -> None:
    take(model, *run(1000, 10, **{"force.x": 7.0}))
    model.gone("no server answers", now(1010))
    made.connect(model, description(), made.OWN_PEER, now(2000))
    [finding] = only(model, now(2000)).verdict.findings
    assert finding.found == "The connection to the server was interrupted", "and no silence"
    sensor = take(model, *run(0, 10))
    assert (sensor.missed, sensor.samples) == (0, 10)
    assert peaks(sensor)[0] == (0, 7)
    other = description()
    other["sensors"][0]["serial"] = 99
    made.describe(model, other, now(10))
    assert only(model, now(10)).peaks is None, "another sensor"


@pytest.mark.parametrize("tared", [True, False])
def test_a_tare_and_a_reset_forget_the_peaks_and_a_reset_past_warnings(model: Model, tared: bool) -> None:
    take(model, *run(0, 10, **{"force.x": 7.0, "warnings": 8}))
    if tared:
        made.happen(model, {"event": Event.OFFSET_CHANGED, "sensor": 0, "offset": [1.0] * 6}, now(10))
    else:
        model.reset()
    sensor = take(model, *run(10, 10))
    assert peaks(sensor)[0] == (0, 0)
    assert texts(sensor) == (["ADC out of sync"] if tared else [])


def test_of_another_sensor_nothing_is_known_of_the_one_before(model: Model) -> None:
    sensor = take(model, *run(0, 10, **{"force.x": 7.0, "warnings": 8}))
    assert (sensor.sample is None, sensor.peaks is None, len(sensor.alerts)) == (False, False, 1)
    made.describe(model, description(), now(10))
    sensor = only(model, now(10))
    assert (sensor.sample is None, sensor.peaks is None, len(sensor.alerts)) == (False, False, 1), "the same"
    other = description()
    other["sensors"][0]["serial"] += 1
    made.describe(model, other, now(10))
    sensor = only(model, now(10))
    assert (sensor.sample, sensor.peaks, sensor.alerts) == (None, None, ())
    sensor = take(model, *run(10, 1))
    assert peaks(sensor)[0] == (0, 0)


def test_a_replay_is_told_from_a_server(model: Model) -> None:
    assert model.state(now(0)).server.replay == ""
    made.connect(model, {**description(), "replay": {"files": ["run.mcap"]}}, made.OWN_PEER, now(0))
    state = model.state(now(0))
    assert state.server.replay == "run.mcap"
    assert "REPLAY run.mcap" in render(state, ViewOptions(), 80).head[0].plain


def test_a_warning_of_one_sample_is_present_for_a_while_and_then_follows_present_ones(
    model: Model,
) -> None:
    take(model, frame(0, {**REST, "warnings": 0b1000}), *run(1, 40))
    (present,) = only(model, now(40)).alerts
    assert (present.level, present.text, present.ago_s) == (Level.TROUBLE, "ADC out of sync", None)
    assert present.remedy == "Contact support (repair required)"
    for first in range(41, 3241, 40):
        last = take(model, *run(first, 40))
    (past,) = last.alerts
    assert past.text == "ADC out of sync"
    assert past.ago_s == pytest.approx(3, abs=0.1)
    assert last.verdict.level is Level.GOOD
    for first in range(3241, 4141, 300):
        last = take(model, *run(first, 300, warnings=0b1100000))
    assert texts(last) == ["Wrong supply voltage", "Overtemperature", "ADC out of sync"], "the worst first"


def test_the_last_emergency_is_told_until_it_is_over_or_reset(model: Model) -> None:
    def after(count: int, code: int, at_s: float) -> list[str]:
        reply = status()
        last = {"code": code, "text": "temperature", "ago_s": 2.0}
        reply["sensors"][0].update(emergencies=count, emergency=last if count else None)
        model.add_status(reply, at_s)
        return texts(only(model, at_s))

    assert after(0, 0, now(0)) == []
    assert after(1, 0x4210, now(0)) == ["Emergency 0x4210 (temperature)"]
    assert only(model, now(0)).verdict.level is Level.LOOK
    model.reset()
    assert after(1, 0x4210, now(80)) == []
    assert after(2, 0x4210, now(160)) == ["Emergency 0x4210 (temperature)"]
    assert only(model, now(160 + 70 * 800)).alerts[-1].ago_s == pytest.approx(70, abs=1)
    model.reset()
    assert after(3, 0x0000, now(240)) == []


def test_drift_is_told(model: Model) -> None:
    reply, six = status(), [0.0, 0.0, 0.25, 0.0, 0.0, 0.0]
    drift = {"since": "tare", "ago_s": 2100, "kelvin": 6.0, "wrench": [5 * value for value in six]}
    reply["sensors"][0].update(drift=drift)
    model.add_status(reply, now(0))
    sensor = only(model, now(0))
    assert texts(sensor) == ["Fz has drifted 1.2 N since the tare 35 min ago, 6 K warmer"]
    assert sensor.zero == texts(sensor)[0]


def test_a_monitor_that_was_not_run_blames_neither_server_nor_sensor(model: Model) -> None:
    """Seen by the thread of the screen first, then by the one that reads."""
    take(model, *run(0, 10))
    model.note_unread(0.0, False, now(10))
    starved = model.state(now(10) + 8.4)
    assert not starved.server.silent
    model.note_unread(8.35, False, now(10) + 8.4)
    model.add_frames(run(10, 1), now(10) + 8.4)
    (alert,) = only(model, now(10) + 8.4).alerts
    assert alert.text == "No new sample for 8.4 s, this computer did not run this program for 8.3 s"
    assert alert.remedy == "Give it a priority, or the computer less to do"


@pytest.mark.parametrize(
    ("unread_s", "why"),
    [(0.49, "the server sends none"), (0.5, "this computer did not run this program for 500 ms")],
)
def test_a_short_time_unread_is_no_reason_for_silence(model: Model, unread_s: float, why: str) -> None:
    take(model, *run(0, 10))
    model.note_unread(unread_s, False, now(9) + 0.9)
    model.add_status(status(), now(9) + 0.9)
    assert texts(only(model, now(9) + 0.9)) == [f"No new sample for 0.9 s, {why}"]


def test_what_is_past_is_told_at_its_worst_and_at_its_last_time(model: Model) -> None:
    at = 0
    for lost in (0, 40, 7):  # then more than a second in which none is
        at += lost
        for _ in range(20):
            take(model, *run(at, 50))
            at += 50
    (alert,) = only(model, now(at)).alerts
    assert re.match(r"40 of \d+ samples .* were lost", alert.text)
    assert alert.ago_s == pytest.approx(0.25, abs=0.1)


def test_what_was_trouble_is_told_as_that_however_little_is_wrong_later(model: Model) -> None:
    """A rate, which has no size."""
    moment, number = frame(0).monotonic_ns, 0
    for periods in (2.0, 1.05, 1.0):
        for _ in range(40):
            frames = list[DataMessage]()
            for _ in range(50):
                moment, number = moment + round(periods * made.PERIOD_NS), number + 1
                frames.append(frame(number, REST)._replace(monotonic_ns=moment))
            at_s = now(0) + (moment - frame(0).monotonic_ns) * 1e-9
            model.add_frames(frames, at_s)
        if periods > 1:
            (alert,) = only(model, at_s).alerts
            assert (alert.level, alert.ago_s) == (Level.TROUBLE if periods > 1.5 else Level.LOOK, None)
    (alert,) = only(model, at_s).alerts
    assert alert.ago_s
    assert alert.level is Level.TROUBLE


def test_the_latest_of_what_is_past_and_the_worst_of_what_is_present_come_first(model: Model) -> None:
    model.connected(description(("BFT-SENS-ECAT-M8",) * 2), made.OWN_PEER, START_S)
    hot: dict[str, float] = {"temperature": LIMITS.temperature_warn + 1}
    seconds: list[dict[str, float]] = [hot, {"warnings": 0b1000}, {}, hot]
    overload = {**REST, "warnings": 0b10001, "force_torque_saturated": 4}
    for at, values in enumerate(seconds):
        for first in range(at * 1000, at * 1000 + 1000, 100):
            others = [frame(k, overload if at == 3 else REST, sensor=1) for k in range(first, first + 100)]
            model.add_frames([*run(first, 100, **values), *others], now(first + 99))
        if at == 2:
            past = [alert.ago_s for alert in model.state(now(2999)).sensors[0].alerts]
            assert past == sorted(past, key=lambda ago_s: ago_s or 0)
            assert len(set(past)) > 1
    level, text = verdict(model.state(now(3999)))
    assert level > Level.LOOK
    assert re.match("sensor 1: .*saturated.*; sensor 0: .*°C", text)


def test_a_lost_sensor_is_told_until_it_is_back_and_later_too(model: Model) -> None:
    """The computer is blamed where the server says so."""
    take(model, *run(0, 10))
    model.add_status(status(), now(10))
    said = "sensor 0 is lost: this computer stood still for 300 ms, check it with ethercat-doctor"
    for message, remedy in (
        ("sensor 0 is lost: no carrier", "Check its cable and power (sensor 0 is lost: no carrier)"),
        (said, said),
    ):
        made.happen(model, {"event": Event.SENSOR_LOST, "sensor": 0, "message": message}, now(10))
        (alert,) = only(model, now(10)).alerts
        assert (alert.text, alert.remedy) == ("The server has lost the sensor", remedy)
    assert (only(model, now(10)).al_state, alert.level) == ("LOST", Level.TROUBLE)
    made.happen(model, {"event": Event.SENSOR_BACK, "sensor": 0}, now(20))
    assert (only(model, now(20)).al_state, only(model, now(20)).verdict.level) == ("OP", Level.GOOD)
    after = status()
    after["missed_deadlines"] += 240
    after["sensors"][0]["recoveries"] += 1
    model.add_status(after, now(20))
    back, past = only(model, now(20)).alerts
    assert back.text == "The server lost the sensor once and has it back"
    assert "stood still" in back.remedy
    assert past.remedy == said


def test_silence_is_the_sensors_only_if_the_server_speaks(model: Model) -> None:
    take(model, *run(0, 10))
    later_s = now(10) + 3
    assert model.state(later_s).server.silent
    assert not only(model, later_s).alerts
    model.add_frames([frame(10, REST, flags=DataFlag.INVALID)], later_s)
    assert not model.state(later_s).server.silent
    assert texts(only(model, later_s)) == ["No new sample for 3.0 s, the sensor does not answer the bus"]
    assert only(model, later_s).old_s == pytest.approx(3, abs=0.1)


def test_the_age_is_that_of_a_new_sample_on_arrival(model: Model) -> None:
    for k, age_us in enumerate((300, 200, 900)):
        model.note_age(frame(k), frame(k).monotonic_ns + age_us * 1000)
    model.note_age(frame(3, flags=DataFlag.REPEATED), frame(3).monotonic_ns + 10**9)
    age = only(model, now(4)).age_us
    assert age is not None
    assert age[:2] == pytest.approx((300, 900), abs=0.01)


@pytest.mark.parametrize(
    ("came", "noted"),
    [([[0, 1, 2], [3]], [3]), ([list(range(2000)), [2000]], [])],
    ids=["some", "endless"],
)
def test_an_age_is_noted_only_of_what_was_waited_for(
    came: list[list[int]], noted: list[int], model: Model
) -> None:
    batches = iter([[frame(k) for k in batch] for batch in came])
    client = SimpleNamespace(
        poll_all=lambda _=0: next(batches),
        session=SimpleNamespace(same_machine=True),
        take_unread=lambda: (0.0, False),
    )
    ages: list[int] = []
    with mock.patch.object(model, "note_age", lambda made, _: ages.append(made.sequence)):
        MonitorReader(Address("localhost", 1), model)._take(cast("Client", client))
    assert ages == noted
    assert only(model, now(4)).samples >= 4


def test_what_came_before_a_tare_is_no_peak_after_it(model: Model) -> None:
    """All of it in one batch, whichever way it is cut."""
    tared = {"event": Event.OFFSET_CHANGED, "sensor": 0, "offset": [9.75, *[0.0] * 5]}
    timeline = Timeline()
    timeline.connected(description())
    before = [frame(0, {"force.x": -9.75}), frame(1, {"force.x": -9.75})]
    items = [*before, tared, *timeline.event(tared), frame(2, {"force.x": 0.5})]
    for cut in range(len(items) + 1):
        batches = iter([items[:cut], items[cut:]])
        client = SimpleNamespace(
            poll_all=lambda _=0, batches=batches: next(batches), take_unread=lambda: (0.0, False),
            session=SimpleNamespace(same_machine=False),
        )  # fmt: skip
        fresh = Model(made.ADDRESS)
        made.connect(fresh, description(), made.OWN_PEER, START_S)
        MonitorReader(Address("localhost", 1), fresh)._take(cast("Client", client))
        assert peaks(only(fresh, now(3)))[0] == (0.5, 0.5), cut


def test_the_servers_clients_have_rates_and_one_of_them_is_this(model: Model) -> None:
    model.add_status(status(sent=1000), START_S + 1)
    assert [client.rate_hz for client in model.state(START_S + 1).clients] == [None, None]
    model.add_status(status(sent=2600), START_S + 3)
    state = model.state(START_S + 4)
    this, other = state.clients
    assert (this.this, this.rate_hz, this.withheld) == (True, 800, 0)
    assert (other.this, other.rate_hz, other.withheld) == (False, 3200, 12)
    assert state.server.uptime_s == 4568


def test_what_is_known_of_the_server_is_that_of_its_last_connection() -> None:
    model, spread = Model("here:1"), {"p50": 1.0, "p99": 2.0, "p999": 3.0, "max": 4.0}

    def known(at_s: float) -> tuple[object, ...]:
        state = model.state(at_s)
        server = state.server
        return server.connected, server.reason, server.since_s, server.heard_s, server.uptime_s, server.silent

    model.gone("no server answers", 1.0)
    assert known(3.0) == (False, "no server answers", 2.0, None, None, False)
    made.connect(model, description(), made.OWN_PEER, 10.0)
    assert known(10.25) == (True, "", 0.25, 0.25, None, False)
    rows = [{"peer": peer, "sent": sent, "withheld": lost} for peer, sent, lost in CLIENTS]
    model.add_status({**status(), "last_10s": {}, "wake_us": spread, "clients": rows}, 11.0)
    assert known(11.5) == (True, "", 1.5, 0.5, 4567.5, True)
    state = model.state(11.5)
    assert [client.peer for client in state.clients] == [made.OWN_PEER, "c", "b", "a"]
    assert (state.server.wake_us and state.server.wake_us[:2], state.server.exchange_us) == ((1.0, 2.0), None)
    model.note_unread(0.0, False, 11.0)
    assert known(11.75)[3] == 0.0, "until somebody has looked"
    for _ in range(10):
        model.add_event({"event": Event.SHUTTING_DOWN}, 12.0)
    assert (known(12.25)[3], len(model.state(12.25).events)) == (0.0, 8)
    for at_s, why in ((20.0, "it ended"), (25.0, "refused")):
        model.gone(why, at_s)
    assert known(26.0) == (False, "refused", 6.0, None, 4567.0, False)
    assert model.state(26.0).clients == ()
    made.connect(model, {**description(), "replay": {}}, made.OWN_PEER, 30.0)
    assert model.state(30.0).server.replay == "a recording"
    assert known(30.0) == (True, "", 0.0, 0.0, None, False)


CLIENTS = (("a", 5, 0), ("b", 9, 0), ("c", 1, 7), (made.OWN_PEER, 0, 0))


def test_a_message_goes_after_half_a_minute(model: Model) -> None:
    model.say("Recorded 1 sample")
    assert [bool(model.state(now(0) + at_s).message) for at_s in (0, 29.9, 30.1)] == [True, True, False]
    model.say("Not tared")
    assert model.state(now(41 * 1000)).message is not None


TOOL = {
    "tool_mass": 0.8, "tool_center_of_gravity": [0.0, 0.0, 0.05], "bias": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "sensor_offset": [0.0] * 6, "contact.surface": "plane 0 0 0.1 0 0 1 0.03",
}  # fmt: skip


def test_with_a_tool_the_newest_sample_is_without_it_and_contact_is_told() -> None:
    model = Model(made.ADDRESS, compensated=partial(NewestCompensated, TOOL, ImuUnits.G_DPS))
    made.connect(model, description(offset=[0.0] * 6), made.OWN_PEER, START_S)
    still = {"force.x": 1.0, "force.z": -0.8 * STANDARD_GRAVITY, "acceleration.z": 1.0}
    pressed = still | {"force.z": still["force.z"] - 20.0, "torque.y": 0.2}  # 10 mm off the axis
    turned = pressed | {"torque.z": 3.0}
    for first, values, words, point in (
        (0, still, "none", None),
        (40, pressed, "press at x 10, y 0, z 100 mm, 95 % region up to", (0.01, 0.0, 0.1)),
        (80, turned, "yes, but not known where: a free moment acts", None),
    ):
        found = take(model, *(frame(k, values) for k in range(first, first + 40))).compensated
        assert found is not None
        assert found.force == pytest.approx((0.0, 0.0, values["force.z"] - still["force.z"]), abs=1e-4)
        assert found.torque == pytest.approx(
            (0.0, values.get("torque.y", 0.0), values.get("torque.z", 0.0)), abs=1e-4
        )
        assert (0.0 < found.force_bound < 2.0, 0.0 < found.torque_bound < 0.2) == (True, True)
        state = model.state(now(first + 40))
        rows = table(state)
        assert any(row.startswith(f"Contact  {words}") for row in rows), rows
        (sensor,) = json_object(state, 0.0)["sensors"]
        contact = sensor["compensated"]["contact"]
        assert (contact["detected"], contact["point"]) == (
            words != "none",
            point and pytest.approx(point, abs=1e-4),
        )
        assert problems("monitor", json.loads(json_line(state, 0.0))) == []
    made.happen(model, {"event": Event.OFFSET_CHANGED, "sensor": 0, "offset": [2.0, *[0.0] * 5]}, now(120))
    found = take(model, *(frame(k, still | {"force.x": 3.0}) for k in range(120, 200))).compensated
    assert found is not None
    assert found.force == pytest.approx((0.0, 0.0, 0.0), abs=1e-4), "the bias follows the sensor's own offset"
    assert (
        take(model, *(frame(k, still | {"force.y": math.nan}) for k in range(200, 240))).compensated is None
    )
    rows = table(model.state(now(240)))
    assert any(
        row.startswith("Compensated  not known of the newest sample: it may not be used") for row in rows
    )
    made.connect(model, description(), made.OWN_PEER, START_S)  # a server that does not tell the offset
    sensor = take(model, *(frame(k, still) for k in range(240, 280)))
    assert sensor.not_compensated == (
        "the wrench cannot be compensated: the sensor's own offset is being changed, or is no longer known: "
        "if this lasts, tare"
    )


def test_what_cannot_be_compensated_is_told() -> None:
    model = Model(made.ADDRESS, compensated=partial(NewestCompensated, TOOL, ImuUnits.G_DPS))
    made.connect(model, description(calibration_matrix=False), made.OWN_PEER, START_S)
    sensor = take(model, *run(0, 40))
    assert sensor.compensated is None
    assert sensor.not_compensated.startswith(
        "the wrench cannot be compensated: settings.calibration_matrix is off"
    )
    with pytest.raises(RecordingError, match=r"contact.surface is 'box'"):
        NewestCompensated(TOOL | {"contact.surface": "box"}, ImuUnits.G_DPS)
