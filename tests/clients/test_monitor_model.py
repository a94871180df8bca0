"""What the monitor makes of frames, replies and events, without a server."""

from __future__ import annotations

import json
import math
import random
import re
from functools import partial
from types import SimpleNamespace
from typing import Any, cast
from unittest import mock

import pytest

from bota_clients.errors import RecordingError
from bota_clients.monitor import model as model_module
from bota_clients.monitor.compensated import NewestCompensated
from bota_clients.monitor.model import Message, Model, Percentiles, SensorView
from bota_clients.monitor.reader import MonitorReader
from bota_clients.monitor.screen import ViewOptions, render, table
from bota_clients.monitor.words import json_line, json_object, verdict
from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.control import Event
from bota_ethercat.framing import DataFlag, DataMessage
from bota_ethercat.health.limits import LIMITS, About, Finding, Level
from bota_ethercat.health.limits import verdict as made_verdict
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


def test_jitter_is_of_samples_that_follow_one_another_at_one_rate(model: Model) -> None:
    def at(k: int, ns: int) -> DataMessage:
        return frame(k)._replace(monotonic_ns=10**12 + ns)

    steady = [at(k, k * made.PERIOD_NS) for k in range(100)]
    steady[20:30] = [each._replace(flags=DataFlag.REPEATED) for each in steady[20:30]]
    steady[50:61] = [steady[60]._replace(flags=DataFlag.GAP)]
    sensor = take(model, *steady)
    assert (sensor.missed, sensor.gaps, sensor.repeated) == (10, 1, 10)
    assert (sensor.jitter_us, sensor.jitter_worst_us) == (0, 0)
    other = description()
    other["sensors"][0]["rate_hz"] /= 2
    made.describe(model, other, now(100))
    sensor = take(model, *(at(k, (2 * k - 99) * made.PERIOD_NS) for k in range(100, 200)))
    assert (sensor.missed, sensor.jitter_us, sensor.jitter_worst_us) == (10, 0, 0)
    sensor = take(model, *(at(k, 2 * k * made.PERIOD_NS + 50_000 * (k % 2)) for k in range(4100, 8200)))
    assert (sensor.jitter_us, sensor.jitter_worst_us) == pytest.approx((50, 50), abs=0.1)


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


def test_a_replay_is_told_from_a_server(model: Model) -> None:
    assert model.state(now(0)).server.replay == ""
    made.connect(model, {**description(), "replay": {"files": ["run.mcap"]}}, made.OWN_PEER, now(0))
    state = model.state(now(0))
    assert state.server.replay == "run.mcap"
    assert "REPLAY run.mcap" in render(state, ViewOptions(), 80).head[0].plain
    made.connect(model, {**description(), "replay": {"files": []}}, made.OWN_PEER, now(0))
    assert model.state(now(0)).server.replay == "a recording"


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


@pytest.mark.parametrize(
    ("unread_s", "why"),
    [(0.49, "the server sends none"), (0.5, "this computer did not run this program for 500 ms")],
)
def test_a_short_time_unread_is_no_reason_for_silence(model: Model, unread_s: float, why: str) -> None:
    take(model, *run(0, 10))
    model.note_unread(unread_s, False, now(9) + 0.9)
    model.add_status(status(), now(9) + 0.9)
    (alert,) = only(model, now(9) + 0.9).alerts
    assert alert.text == f"No new sample for 0.9 s, {why}"
    assert ("Give it a priority, or" in alert.remedy) is (unread_s == 0.5)


def test_the_worst_of_what_is_present_comes_first(model: Model) -> None:
    model.connected(description(("BFT-SENS-ECAT-M8",) * 2), made.OWN_PEER, START_S)
    overload = {**REST, "warnings": 0b10001, "force_torque_saturated": 4}
    hot = run(0, 100, temperature=LIMITS.temperature_warn + 1)
    model.add_frames([*hot, *(frame(k, overload, sensor=1) for k in range(100))], now(99))
    level, text = verdict(model.state(now(99)))
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
    made.connect(model, description(offset=[0.0] * 6), made.OWN_PEER, START_S)
    assert only(model, now(120)).compensated is None, "it is the connection's before"
    take(model, *(frame(k, still | {"force.y": math.nan}) for k in range(120, 160)))
    rows = table(model.state(now(160)))
    assert any(
        row.startswith("Compensated  not known of the newest sample: it may not be used") for row in rows
    )
    made.connect(model, description(), made.OWN_PEER, START_S)  # a server that does not tell the offset
    sensor = take(model, *(frame(k, still) for k in range(160, 200)))
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


def finding(key: str, level: Level, size: float) -> Finding:
    return Finding(level, About.STREAM, key, f"{key} {level} {size}", "Look", size)


@pytest.mark.parametrize("seed", range(12))
def test_any_course_of_events_comes_to_what_it_is_by_definition(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that happened is kept here, and looked through anew each time."""
    draw, model, at_s = random.Random(seed), Model(made.ADDRESS), START_S
    here: list[Finding] = []  # what is found at the moment
    monkeypatch.setattr(model_module, "judge", lambda _: made_verdict(here))
    monkeypatch.setattr(model_module, "clock_text", lambda: "12:00:00")
    monkeypatch.setattr(model_module, "event_sentence", lambda event: event["offset"][0])
    wrenches: dict[int, list[tuple[float, ...]]] = {}  # since the reset, by sensor
    found: dict[int, list[tuple[float, Finding]]] = {}
    newest: dict[int, tuple[float, ...] | None] = {}
    statuses: list[tuple[float, dict[str, int]]] = []
    described, connected, since, heard, reason = 0, False, None, 0.0, ""
    spread, serial = dict[str, float](), 1
    read_s, said, shown_s, events, numbers, tared = math.inf, "", 0.0, list[str](), [0, 0, 0], False
    for _ in range(150):
        at_s += draw.choice((0.0, 0.01, 0.1, 0.2, 0.45, 0.49, 0.5, 0.6, 7.0, 31.0))
        here[:] = [
            finding(key, draw.choice((Level.LOOK, Level.TROUBLE)), draw.randrange(3))
            for key in draw.sample("abc", draw.choice((0, 0, 1, 2)))
        ]
        here.sort(key=lambda each: -each.level)
        what = draw.choice(
            ("frames",) * 6 + ("status", "status", "tare", "say", "gone", "connect", "reset", "read")
        )
        if what == "connect":
            described = draw.choice((1, 2))
            known = description(("BFT-SENS-ECAT-M8",) * described)
            if draw.random() < 0.3:  # another sensor
                serial += 2
                for kept in (wrenches, found, newest):
                    kept.pop(0, None)
            known["sensors"][0]["serial"] = serial
            made.connect(model, known, made.OWN_PEER, at_s)
            connected, since, heard, reason = True, at_s, at_s, ""
            wrenches = {n: wrenches.get(n, []) for n in range(described)}
            found = {n: found.get(n, []) for n in range(described)}
            if tared:  # which this server does not tell
                wrenches[0], tared = [], False
            newest, statuses = {n: newest.get(n) for n in range(described)}, []
        elif what == "gone":
            since = at_s if connected or since is None else since
            reason = draw.choice(("it ended", "refused"))
            connected, statuses = False, [(at, {}) for at, _ in statuses[-1:]]
            model.gone(reason, at_s)
        elif what == "frames":
            frames = list[DataMessage]()
            for _ in range(draw.randrange(5)):
                position, flags = draw.randrange(3), draw.choice((0, 0, 0, REPEATED, INVALID))
                numbers[position] += 1
                six = tuple(
                    draw.choice((draw.randrange(-9, 9), math.nan if axis else 1)) for axis in range(6)
                )
                values = dict(zip(SIX, six, strict=True))
                frames.append(frame(numbers[position], values, sensor=position, flags=flags))
                if position < described:
                    found[position] += [(at_s, each) for each in here]
                    if not flags:
                        wrenches[position].append(six)
                        newest[position] = six
            heard = at_s if frames else heard
            model.add_frames(frames, at_s)
        elif what == "status" and connected:
            rows = {peer: draw.randrange(9999) for peer in draw.sample(("a", "b", made.OWN_PEER), 2)}
            told = [{"peer": peer, "sent": sent, "withheld": sent % 3} for peer, sent in rows.items()]
            spread = {"p50": float(sent), "p99": 9.0} if (sent := draw.choice((0, 7))) else {}
            recent = {"last_10s": {"exchange_us": {"p50": 1.0, "p99": 2.0}}}
            more = {"wake_us": spread, "exchange_us": spread, "clients": told}
            model.add_status({**status(described), **recent, **more}, at_s)
            statuses, heard = [*statuses, (at_s, rows)], at_s
        elif what == "tare" and connected and described:
            offset = [draw.random()] * 6
            made.happen(model, {"event": Event.OFFSET_CHANGED, "sensor": 0, "offset": offset}, at_s)
            heard, events = at_s, [*events, f"12:00:00 {offset[0]}"]
            wrenches[0], tared = [], True
        elif what == "say":
            said, shown_s = f"12:00:00 {at_s}", 0.0
            model.say(f"{at_s}", said.endswith("0"))
        elif what == "reset":
            wrenches, found = {n: [] for n in range(described)}, {n: [] for n in range(described)}
            model.reset()
        elif what == "read":
            read_s = at_s
            model.note_unread(0.0, False, at_s)
        if draw.random() < 0.3:
            continue
        state = model.state(at_s)
        server = state.server
        shown_s = shown_s or at_s + 30
        said = said if at_s <= shown_s else ""
        assert state.message == (Message(said, said.endswith("0")) if said else None)
        assert [*state.events] == events[-8:]
        heard_s = max(min(at_s, read_s) - heard, 0.0) if connected else None
        assert (server.connected, server.reason, server.heard_s) == (connected, reason, heard_s)
        assert server.since_s == (None if since is None else at_s - since)
        speaks = heard_s is not None and heard_s < 0.5
        assert server.silent == (connected and not speaks)
        if connected:
            assert server.exchange_us == (Percentiles(1.0, 2.0) if statuses else None)
            assert server.wake_us == (Percentiles(spread["p50"], 9.0) if statuses and spread else None)
        uptime = 4567.0 + (at_s - statuses[-1][0] if connected else 0.0) if statuses else None
        assert server.uptime_s == (None if uptime is None else pytest.approx(uptime))
        clients = []
        if connected and statuses:
            passed = statuses[-1][0] - statuses[-2][0] if len(statuses) > 1 else 0
            before = statuses[-2][1] if len(statuses) > 1 else {}
            for peer, sent in statuses[-1][1].items():
                rate = (sent - before[peer]) / passed if peer in before and passed else None
                clients.append((peer, peer == made.OWN_PEER, rate, sent, sent % 3))
        assert [*map(tuple, state.clients)] == sorted(
            clients, key=lambda each: (not each[1], -each[4], -each[3])
        )
        assert [sensor.position for sensor in state.sensors] == [*range(described)]
        for number, view in enumerate(state.sensors):
            if speaks:
                found[number] += [(at_s, each) for each in here]
            finite = [[*filter(math.isfinite, axis)] for axis in zip(*wrenches[number], strict=True)]
            extremes = [(min(axis, default=0.0), max(axis, default=0.0)) for axis in finite] or None
            assert (view.peaks and [*map(tuple, view.peaks)]) == extremes
            last, read = newest.get(number), view.sample and (*view.sample.force, *view.sample.torque)
            assert read == (last and pytest.approx(last, nan_ok=True))
            past = dict[str, tuple[float, Finding]]()
            for when, each in found[number]:
                worst = past[each.key][1] if each.key in past else each
                past[each.key] = when, max(each, worst, key=lambda one: (one.level, one.size))
            present = {each.key: each for each in here if speaks}
            alerts: list[Any] = [(each.level, each.found, None) for each in present.values()]
            alerts += [
                (each.level, each.found, at_s - when)
                for key, (when, each) in sorted(past.items(), key=lambda entry: -entry[1][0])
                if key not in present
            ]
            assert [(each.level, each.text, each.ago_s) for each in view.alerts] == alerts


REPEATED, INVALID = int(DataFlag.REPEATED), int(DataFlag.INVALID)
SIX = tuple(f"{name}.{axis}" for name in ("force", "torque") for axis in "xyz")
