"""What a sensor shows of itself, in the log, in `status` and as events: silence, NaN, CoE emergencies."""

from __future__ import annotations

import itertools
import math
import struct
from typing import Any

import pytest

from bota_ethercat.pdo import LAYOUTS, encode
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.ethercat.slave.coe import Emergency
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation, check_frames, life_of, more_if_long

SLOW = {"sinc_length": 512}  # the fewer samples, the faster it is simulated


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level("INFO")
    return caplog


def said(log: pytest.LogCaptureFixture, words: str) -> list[str]:
    return [record.getMessage() for record in log.records if words in record.getMessage()]


def test_a_sensor_that_gives_nothing_new_is_logged_and_so_is_its_end(log: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(settings=SLOW)
    simulation.run(2.0)
    simulation.command("stick")
    simulation.run(0.5)
    assert not said(log, "gives nothing new"), "for a moment"
    simulation.run(5.0)
    assert len(said(log, "sensor 0 gives nothing new")) == 1
    simulation.command("unstick")
    simulation.run(5.0)
    assert len(said(log, "sensor 0 gives new samples again after")) == 1
    assert len(said(log, "gives nothing new")) == 1


def test_a_sensor_that_is_lost_is_not_also_silent(log: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(settings=SLOW)
    simulation.run(2.0)
    simulation.command("power cycle 5")
    simulation.run(10.0)
    assert said(log, "is back after")
    assert not said(log, "gives n")


def measure(simulation: Simulation, **values: float) -> None:
    """Have sensor 0 measure these values from now on, each sample a new one; as it did before without any."""
    sampler: Any = life_of(simulation.backend).sampler
    vars(sampler).pop("newest", None)
    if values:
        newest, count = sampler.newest, itertools.count()
        last: list[bytes] = [b"", b""]

        def changed(later: int = 0) -> bytes:
            if last[0] != newest(later):
                last[:] = newest(later), encode(len(newest(later)), {**values, "torque.z": next(count)})
            return last[1]

        sampler.newest = changed


FIELDS, VALUES = (
    ("force.x", "acceleration.z", "temperature", "orientation.w"),
    (math.nan, math.inf, -math.inf),
)


@pytest.mark.parametrize(
    ("field", "value"),
    more_if_long([*zip(FIELDS, (*VALUES, math.nan), strict=True)], itertools.product(FIELDS, VALUES)),
)
def test_samples_that_are_not_finite_are_counted(field: str, value: float) -> None:
    simulation = Simulation(SensorOptions(pdo_size=max(LAYOUTS)))
    simulation.run(0.1)
    before = simulation.streams[0].fresh
    assert simulation.status()["sensors"][0]["not_finite"] == 0
    measure(simulation, **{field: value})
    simulation.run(0.1)
    counted = simulation.streams[0].fresh - before
    measure(simulation)
    simulation.run(0.1)
    assert counted > 70
    assert simulation.status()["sensors"][0]["not_finite"] == pytest.approx(counted, abs=2)


def test_not_finite_is_logged_when_it_begins_and_when_it_is_over(log: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(settings=SLOW)
    simulation.run(2.0)
    for _ in range(4):  # on and off, but never for long
        measure(simulation, **{"force.x": math.nan})
        simulation.run(1.5)
        measure(simulation)
        simulation.run(3.0)
    assert len(said(log, "sensor 0 measures NaN or infinity: ")) == 1
    assert not said(log, "measures finite numbers again")
    simulation.run(10.0)
    assert len(said(log, "sensor 0 measures finite numbers again")) == 1


# -- CoE emergencies: read from the mailbox, kept, counted, logged and told, whatever else goes on there

HOT = "emergency 0x4210 0x09 0102030405"
CLOCK = SensorOptions(signal="clock")


def told(simulation: Simulation) -> list[JsonObject]:
    return [event for event in simulation.events if event["event"] == "emergency"]


def test_an_emergency_is_told_logged_and_kept(log: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(CLOCK, CLOCK, settings=SLOW)
    client = simulation.subscribe()
    simulation.run(1.0)
    assert client.ask("status")["sensors"][1]["emergencies"] == 0
    assert client.ask("status")["sensors"][1]["emergency"] is None
    simulation.command(f"{HOT} @1")
    reported = {"code": 0x4210, "text": "temperature", "register": 9, "data": "0102030405"}
    event = client.wait_event("emergency", 1)
    words = "sensor 1 reports emergency 0x4210 (temperature), error register 0x09, data 0102030405"
    assert event == {"event": "emergency", "sensor": 1, **reported, "count": 1, "message": words}
    assert said(log, "emergency") == [words]
    simulation.run(2.0)
    first, second = client.ask("status")["sensors"]
    assert (first["emergencies"], first["emergency"]) == (0, None)
    assert second["emergencies"] == 1
    assert second["emergency"].pop("ago_s") == pytest.approx(2.0, abs=0.2)
    assert second["emergency"] == reported
    for number in range(2):
        check_frames(frame for frame in simulation.frames if frame.sensor == number)
    assert [stream.lost_samples for stream in simulation.streams] == [0, 0]


def test_a_flood_floods_neither_log_nor_clients_nor_the_bus(log: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(CLOCK, settings=SLOW)
    for n in range(1550):
        simulation.at(n * 0.02, HOT)
    simulation.run(31.0)
    counted = simulation.status()["sensors"][0]["emergencies"]
    assert counted == pytest.approx(295, rel=0.1), "ten a second are read, where exchanges allow"
    assert len(told(simulation)) == 4, "one in ten seconds"
    assert told(simulation)[-1]["count"] > 250
    assert len(said(log, "reports emergency")) == 4
    assert simulation.streams[0].lost_samples == 0


def test_no_answer_is_taken_from_a_job_and_no_emergency_is_lost_to_it() -> None:
    """The answer would be asked for again after 0.7 s."""
    simulation = Simulation(CLOCK)
    client = simulation.connect()
    simulation.run(1.0)
    for n in range(50):
        simulation.at(n * 0.025, HOT)
    for _ in range(50):
        asked_ns = simulation.clock.now_ns
        assert client.ask("sdo_read", index=0x8011, type="u16")["value"] == 800
        assert simulation.clock.now_ns - asked_ns < 400_000_000
    simulation.run_until(lambda: simulation.status()["sensors"][0]["emergencies"] == 50, "all of them")
    assert simulation.streams[0].lost_samples == 0


def test_messages_of_every_length_and_service_are_parsed_or_not() -> None:
    message = struct.pack("<HHB", 0x1000, 0x1234, 0x81) + b"abcdefg"
    for length in range(12):
        expected = Emergency(0x1234, 0x81, b"abcde"[: length - 5]) if length >= 5 else None
        assert Emergency.parse(message[:length]) == expected
    for service in (0, 2, 3, 4, 8, 15):
        assert Emergency.parse(struct.pack("<HHB5s", service << 12, 1, 1, b"")) is None
