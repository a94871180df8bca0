"""What is in force: one fold of descriptions, events and frames, for a connection and a recording alike."""

from __future__ import annotations

from typing import Any

import pytest

from bota_ethercat.client import Client
from bota_ethercat.control import Event
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce, Timeline
from bota_ethercat.stream.usable import CHANNELS, Usability, judge
from bota_ethercat.text.json_text import JsonObject
from tests.bridge.scripted_server import MemoryServer, ScriptedChannel
from tests.descriptions import description, sensor_row


def reconfigured(sinc_length: int, rate_hz: float, **more: Any) -> JsonObject:
    settings = {"sinc_length": sinc_length}
    return {"event": Event.RECONFIGURED, "sensor": 0, "settings": settings, "rate_hz": rate_hz, **more}


def test_a_description_that_was_sent_before_an_event_does_not_override_it() -> None:
    """The reply waits for the thread that asked for it, which reads it after the event was handled."""
    server = MemoryServer()
    server.description = description(sensor_row(offset=[0.0] * 6))
    with Client(1, sensors=[0], channel=ScriptedChannel(server)) as client:
        client.connect()
        client.poll()
        reply = client.request("describe")  # answered at once: the answer is on its way
        server.send_json(reconfigured(1024, 50.0, offset=[1.0] * 6))
        server.send_sample(1.0)
        items = client.poll_all()
        assert reply.result()["sensors"][0]["rate_hz"] == 800
        in_force = client.session.timeline[0]
        assert (in_force.info.rate_hz, in_force.info.offset) == (50.0, (1.0,) * 6)
        assert client.session.state(0).accounting.rate_hz == 50.0
        kinds = [type(item) for item in items]
        assert kinds == [dict, InForce, DataMessage], "what is in force stands before its frames"
        assert items[1] == in_force


def test_a_description_that_is_newer_counts_whoever_asked() -> None:
    server = MemoryServer()
    with Client(1, sensors=[0], channel=ScriptedChannel(server)) as client:
        client.connect()
        server.description["sensors"][0] |= {"state": "PREOP", "settling": True}
        client.ask("describe")
        assert client.session.timeline[0].info.state == "PREOP"
        assert client.session.timeline[0].epoch == 0, "the same stream"
        assert [item.info.settling for item in client.poll_all() if isinstance(item, InForce)] == [
            False,
            True,
        ]


def row(**changes: Any) -> JsonObject:
    return description(sensor_row(0, offset=[0.0] * 6, **changes), sensor_row(1))


STORIES: dict[str, tuple[list[tuple[str, Any]], dict[str, Any]]] = {
    "an offset leaves the rest": (
        [("event", {"event": "offset_changed", "sensor": 0, "offset": [2.0] * 6, "rate_hz": 5})],
        {"offset": (2.0,) * 6, "rate_hz": 800, "epoch": 1},
    ),
    "an offset that is not known any more": (
        [("event", {"event": "offset_changed", "sensor": 0})], {"offset": None, "epoch": 1},
    ),
    "other settings are another stream": ([("event", reconfigured(512, 100.0))], {"epoch": 2}),
    "the loss of a sensor": (
        [("event", {"event": "sensor_lost", "sensor": 0, "message": "no power"})],
        {"lost": "no power", "state": "LOST", "epoch": 2},
    ),
    "another sensor in its place": (
        [("event", {"event": "sensor_lost", "sensor": 0, "reason": "different_sensor"})],
        {"lost": "sensor 0 is lost", "state": "REFUSED", "epoch": 2},
    ),
    "its return": (
        [("event", {"event": "sensor_lost", "sensor": 0}), ("event", {"event": "sensor_back", "sensor": 0})],
        {"lost": None, "state": "OP", "rate_hz": 800, "epoch": 3},
    ),
    "a sample after its loss": (
        [("event", {"event": "sensor_lost", "sensor": 0}), ("sampled", 0)],
        {"lost": None, "state": "OP", "epoch": 2},
    ),
    "an offset while it is lost": (
        [("event", {"event": "sensor_lost", "sensor": 0, "message": "no power"}),
         ("event", {"event": "offset_changed", "sensor": 0, "offset": [1.0] * 6})],
        {"lost": "no power", "offset": (1.0,) * 6},
    ),
    "a connection, of a machine that was restarted": (
        [("event", {"event": "sensor_lost", "sensor": 0}), ("connected", row(name="X") | {"boot_id": "b"})],
        {"lost": None, "name": "X", "clock": "b", "epoch": 4},
    ),
    "a description of another rate": ([("describe", row(rate_hz=400.0))], {"rate_hz": 400.0, "epoch": 2}),
    "a description that says nothing new": ([("describe", row())], {"epoch": 1}),
    "a description of another sensor": ([("describe", row(serial=7))], {"serial": 7, "epoch": 2}),
    "events of others, and of nobody": (
        [("event", reconfigured(32, 1600.0) | {"sensor": 1}), ("event", {"event": "emergency", "sensor": 0}),
         ("event", {"event": "shutting_down"}), ("event", {"event": "reconfigured", "sensor": -1})],
        {"rate_hz": 800, "epoch": 1},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("steps", "expected"), STORIES.values(), ids=STORIES)
def test_the_fold(steps: list[tuple[str, Any]], expected: dict[str, Any]) -> None:
    timeline = Timeline()
    assert [now.sensor for now in timeline.connected(row())] == [0, 1]
    timeline.connected(row())
    told = {0: timeline[0]}
    for name, value in steps:
        told |= {now.sensor: now for now in getattr(timeline, name)(value)}
    now = timeline[0]
    assert now == told[0], "each change is told"
    assert now._asdict() | now.info._asdict() | expected == now._asdict() | now.info._asdict()
    assert set(timeline) == {0, 1}
    assert timeline[7] == InForce(SensorInfo(7)), "of which nothing is known"


def test_how_long_an_offset_is_in_doubt() -> None:
    now = InForce(SensorInfo(rate_hz=800.0))
    assert (now.doubt_ns, now.doubt_after_ns) == (100_000_000, 2_500_000)
    slow = InForce(SensorInfo(rate_hz=50.0))
    assert (slow.doubt_ns, slow.doubt_after_ns) == (480_000_000, 40_000_000)
    assert InForce(SensorInfo()).doubt_after_ns == 0


FINE = Sample((0.0,) * 3, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, 20.0, (0.0, 0.0, 0.0, 1.0), 0, 0, 0, 0, 0)
F, A, R, T, Q = (channel.name for channel in CHANNELS)
BITS = {
    0: {F: 1},
    1: {A: 1, Q: 1},
    2: {R: 1, Q: 1},
    3: {F: 2},
    4: {F: 1},
    6: dict.fromkeys((F, A, R, T, Q), 2),
}
VALUES: dict[str, dict[str, int]] = {
    "force_torque_saturated": {F: 1}, "acceleration_saturated": {A: 1, Q: 1},
    "angular_rate_saturated": {R: 1, Q: 1}, "status": {},
}  # fmt: skip
NAN = {"force": F, "torque": F, "acceleration": A, "angular_rate": R, "orientation": Q}


def changed(name: str, value: Any) -> Sample:
    return FINE._replace(**{name: value})


def judged(sample: Sample) -> dict[str, int]:
    for channel in CHANNELS:
        usability, why = judge(sample, [channel])
        assert usability is channel.judge(sample)
        assert bool(why) is (usability > 0) is bool(channel.flagged(sample) or not channel.is_finite(sample))
    return {channel.name: int(channel.judge(sample)) for channel in CHANNELS if channel.judge(sample)}


def test_which_channels_may_be_used() -> None:
    assert judged(FINE) == judged(FINE._replace(orientation=None)) == {}
    for bit in range(32):
        assert judged(FINE._replace(warnings=1 << bit)) == BITS.get(bit, {}), bit
    for name, expected in VALUES.items():
        for bit in (0, 7):
            assert judged(changed(name, 1 << bit)) == expected, name
    for name, channel in NAN.items():
        values = getattr(FINE, name)
        for place in range(len(values)):
            for odd in (float("nan"), float("inf"), -float("inf")):
                bad = (*values[:place], odd, *values[place + 1 :])
                assert judged(changed(name, bad)) == {channel: 2}
    assert judged(FINE._replace(temperature=float("nan"))) == {T: 2}
    worst, why = judge(FINE._replace(warnings=0b1010), CHANNELS)
    assert (worst, why) == (
        Usability.FAULTY, "force or torque was not finite, or of a sensor that reports a fault",
    )  # fmt: skip
