"""Settings, SDO access and tare through the control channel while the sensor streams, in simulated time.

Changes that fail or are cut off leave the former settings in force, and say so.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any, cast

import pytest

from bota_ethercat.address import boot_id
from bota_ethercat.framing import MAX_JSON_LENGTH, DataFlag, encode_json
from bota_ethercat.sensor.filters import FORCE_TORQUE_FILTERS
from bota_ethercat.sensor.meaning import value_meaning
from bota_ethercat.sensor.sdo_types import SDO_TYPE_NAMES
from bota_ethercat.settings import SETTINGS, SettingValue
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.acquisition.cycle import Cycle
from ethercat_server.errors import BusError
from ethercat_server.sensor.objects.dictionary import FACTORY_CALIBRATION
from ethercat_server.sensor.sensor import Identity, Sensor
from ethercat_server.serving.actions import Actions
from ethercat_server.serving.connection import Connection
from ethercat_server.serving.hub import Hub
from ethercat_server.serving.sensor_actions import SensorActions
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import (
    AT_REST,
    Bench,
    Simulation,
    asked,
    check_frames,
    fresh,
    more_if_long,
    reading,
)

RATE, FILTERS, OFFSET, CONFIGURATION = 0x8011, 0x8006, 0x8000, 0x8010
IN_OP = {"temperature_compensation": True, "imu_active": 3}
BY_PREOP = {"chop": True, "sinc_length": 128}
ABORT = "0x08000021"
FX_5 = [5.0, 0, 0, 0, 0, 0]


@pytest.fixture
def streaming() -> Bench:
    """On a sensor whose samples are numbered."""
    return Bench(SensorOptions(signal="clock", ppm=150.0))


@pytest.fixture
def bench() -> Bench:
    """On a stationary sensor."""
    return Bench()


@pytest.fixture(scope="module")
def shared() -> Bench:
    """For what leaves the sensor as it is."""
    return Bench()


def offset(bench: Bench) -> list[float]:
    """What the sensor itself holds."""
    return [bench.ask("sdo_read", index=OFFSET, subindex=n, type="f32")["value"] for n in range(1, 7)]


def held(bench: Bench, index: int, subindex: int) -> int:
    """What the sensor itself holds, in one byte."""
    return int(bench.ask("sdo_read", index=index, subindex=subindex)["hex"], 16)


# -- objects


def test_objects_are_read_by_index_in_any_notation(shared: Bench) -> None:
    assert shared.ask("sdo_read", index=RATE, type="u16")["value"] == 800
    assert shared.ask("sdo_read", index="0x8011", subindex=0, sensor=0)["hex"] == "2003"
    assert shared.ask("sdo_read", index="0x1008", type="string")["value"] == "BFT-SENS-ECAT-M8"
    refused = shared.refused("sdo_read", index=0x8003)
    assert (refused["code"], refused["abort_code"]) == ("sensor", 0x06020000)
    assert shared.ask("sii_read", word=8)["hex"] == "7ab00000", "and words of the EEPROM"
    assert shared.ask("sii_read", word="0x9", words=1)["hex"] == "0000"


def test_objects_are_read_by_name(shared: Bench) -> None:
    rate = shared.ask("sdo_read", name="Sampling Rate")
    assert (rate["index"], rate["subindex"], rate["type"], rate["value"]) == (RATE, 0, "u16", 800)
    assert shared.ask("sdo_read", name="sinc_length")["value"] == 384, "not what was written"
    imu = shared.ask("sdo_read", name="IMU active")
    assert (imu["type"], imu["value"]) == ("u8", 1)
    assert shared.ask("sdo_read", name="control status")["name"] == "Control Status"
    assert shared.ask("sdo_read", name="Device name")["value"] == "BFT-SENS-ECAT-M8"
    assert shared.ask("sdo_read", name="FIR disable", type="bool")["value"] is True


def test_objects_are_written(bench: Bench) -> None:
    assert bench.ask("sdo_write", index=OFFSET, subindex=2, type="f32", value=1.5)["ok"]
    assert offset(bench)[1] == 1.5
    assert bench.ask("sdo_write", index=OFFSET, subindex=2, hex="00000000")["ok"]
    assert offset(bench)[1] == 0
    refused = bench.refused("sdo_write", index=FILTERS, subindex=1, type="u16", value=128)
    assert (refused["code"], refused["abort_code"]) == ("sensor", 0x08000022), "in PREOP only"


def test_a_setting_that_is_written_as_an_object_is_told_to_all(bench: Bench) -> None:
    for value in (0, 0, 1):
        assert bench.ask("sdo_write", index=CONFIGURATION, subindex=1, type="u8", value=value)["ok"]
    assert bench.ask("sdo_write", index=OFFSET, subindex=2, type="f32", value=1.5)["ok"], "no setting"
    assert bench.ask("configure", settings={"imu_active": 3})["ok"]
    told = [event["settings"] for event in bench.asking.events if event["event"] == "reconfigured"]
    matrix_and_imu = [(settings["calibration_matrix"], settings["imu_active"]) for settings in told]
    assert matrix_and_imu == [(False, 1), (True, 1), (True, 3)]


@pytest.mark.parametrize(
    ("action", "keys", "named"),
    [
        ("sdo_read", {"index": RATE, "type": "f32"}, "f32"),
        ("sdo_read", {"index": RATE, "sensor": 3}, "sensor"),
        ("sdo_read", {"name": "Status"}, "2 objects: Measurement Status, Control Status"),
        ("sdo_read", {"name": "colour"}, "no object's"),
        ("sdo_read", {"name": ""}, "a text of 1 to 80 characters"),
        ("sdo_read", {"name": "x" * 81}, "a text of 1 to 80 characters"),
        ("sdo_read", {"name": "Sampling rate", "subindex": 0}, "'subindex'"),
        ("sdo_read", {}, "needs either the key 'index' or"),
        ("sii_read", {"word": 65536}, "'word'"),
        ("sii_read", {"word": 0, "words": 129}, "'words'"),
        ("sdo_write", {"index": OFFSET}, "either the keys 'type' and 'value' or the key 'hex'"),
        ("sdo_write", {"index": OFFSET, "type": "f32", "value": 1, "hex": "00"}, "either"),
        ("sdo_write", {"index": OFFSET, "type": "u8", "value": 256}, "'value' must be a number that is a u8"),
        ("sdo_write", {"index": OFFSET, "type": "quaternion", "value": 1}, "'type' must be one of bool, i8"),
        ("sdo_write", {"index": OFFSET, "hex": "0"}, "'hex'"),
        ("sdo_write", {"index": OFFSET, "hex": "00" * 113}, "'hex' must be 1 to 112 bytes"),
        ("sdo_write", {"index": 0x1008, "type": "string", "value": "x" * 113}, "must be 1 to 112 bytes"),
        ("sdo_write", {"index": 65536, "hex": "00"}, "'index'"),
        ("sdo_write", {"index": OFFSET, "subindex": -1, "hex": "00"}, "'subindex'"),
        ("sdo_write", {"hex": "00"}, "needs the key 'index'"),
        ("configure", {"settings": {}}, "an object with settings"),
        ("configure", {"settings": {"colour": 1}}, "no setting 'colour': the settings are calib"),
        ("configure", {"settings": {"fast": True}}, "fast is true but fir is false"),
        ("tare", {"samples": 20, "target": [1e300, 0, 0, 0, 0, 0]}, "'target' cannot be"),
    ],
)  # fmt: skip
def test_a_bad_request_is_refused_by_name_and_the_sensor_untouched(
    shared: Bench, action: str, keys: dict[str, object], named: str
) -> None:
    before = shared.ask("describe")["sensors"], shared.stats()["sdo_write_count"]
    refused = shared.refused(action, **keys)
    assert refused["code"] == "bad_request"
    assert named in refused["message"]
    assert (shared.ask("describe")["sensors"], shared.stats()["sdo_write_count"]) == before


def test_a_sensor_of_a_chain_is_named_by_position_serial_number_or_name() -> None:
    rows = (("BFT-SENS-ECAT-M8", 11), ("BFT-ROKS-ECAT-M8", 22), ("BFT-ROKS-ECAT-M8", 33))
    bench = Bench(*(SensorOptions(model=m, serial=n, signal="rest") for m, n in rows))
    for choice, position in ((1, 1), ("2", 2), ("serial:22", 1), ("BFT-SENS-ECAT-M8", 0)):
        assert bench.ask("tare", sensor=choice, samples=1, target=[float(position)] * 6)["ok"]
        read = bench.ask("sdo_read", sensor=choice, index=0x1018, subindex=4, type="u32")
        assert read["value"] == rows[position][1]
        assert bench.ask("configure", sensor=choice, settings={"imu_active": 3})["sensor"] == position
    for choice in ("BFT-ROKS-ECAT-M8", "serial:44", 3, "BFT-MEGS-ECAT-M8"):
        refused = bench.refused("sdo_read", sensor=choice, index=RATE)
        assert refused["code"] == "bad_request"
        assert "2: BFT-ROKS-ECAT-M8 with serial 33" in refused["message"], "it lists those there are"
    for wrong in (-1, 256, "", None, 1.5, "serial:x", ["0"]):
        assert bench.refused("sdo_read", sensor=wrong, index=RATE)["code"] == "bad_request"


# -- 0x2000, the factory calibration: the virtual sensor counts every attempt to write it

WAYS_TO_SAY_IT: tuple[Any, ...] = (0x2000, "0x2000", "8192", "0X2000", "0x02000", "08192", " 8192 ", "8_192")


def test_the_control_channel_writes_none_of_the_factory_calibration(bench: Bench) -> None:
    def write(*codes: str, **keys: object) -> None:
        assert bench.refused("sdo_write", **keys)["code"] in codes

    before = [bench.ask("sdo_read", index=0x2000, subindex=sub)["hex"] for sub in range(58)]
    for subindex in range(256):
        write("denied", index=FACTORY_CALIBRATION, subindex=subindex, hex="00000000")
    for kind in SDO_TYPE_NAMES:
        value = {"string": "x", "bool": True}.get(kind, 1)
        write("denied", index=FACTORY_CALIBRATION, subindex=1, type=kind, value=value)
    for index in WAYS_TO_SAY_IT:
        write("denied", "bad_request", index=index, subindex=1, hex="00" * 4)
    for notation in WAYS_TO_SAY_IT[:3]:
        write("denied", index=notation, subindex=1, type="f32", value=2.5)
    for keys in (
        {"index": FACTORY_CALIBRATION, "subindex": 0, "hex": "00" * 112},  # all of it at once
        {"index": FACTORY_CALIBRATION, "subindex": 0, "hex": "00", "complete_access": True},
        {"index": FACTORY_CALIBRATION + 0x10000, "subindex": 1, "hex": "00" * 4},
        {"index": 8192.0, "subindex": 1, "hex": "00" * 4},
        {"name": "Calibration 1", "hex": "00" * 4},
        {"index": OFFSET, "name": "Calibration 1", "hex": "00" * 4},
    ):
        write("denied", "bad_request", **keys)
    for name in ("Calibration 1", "0x2000:1", "0x2000"):
        assert bench.refused("configure", settings={name: 1})["code"] == "bad_request"
    assert before == [bench.ask("sdo_read", index=0x2000, subindex=sub)["hex"] for sub in range(58)]
    assert bench.stats()["calibration_writes"] == 0


def test_every_path_to_a_sensor_that_writes_is_guarded() -> None:
    """Whoever takes an `Sdo` wraps it, or only identifies with it; to map process data, objects are read."""
    root = Path(__file__).parents[2] / "ethercat_server"
    for path in root.rglob("*.py"):
        if path.is_relative_to(root / "ethercat") or path.is_relative_to(root / "virtual_sensor"):
            assert ".sdo.write(" not in path.read_text(), path
            continue
        for used in re.findall(r"^.*\b(?:MailboxSdo\(|_ServerSdo\(|slaves\[.*\]\.sdo\b|slave\.sdo\b).*$",
                               path.read_text(), re.MULTILINE):  # fmt: skip
            assert "GuardedSdo(" in used or "identify(" in used or ".sdo.poll_mailbox(" in used, (
                f"{path}: {used}"
            )


# -- settings


def test_a_setting_that_any_state_takes_is_changed_without_a_pause(streaming: Bench) -> None:
    streaming.listener.fresh(100)
    invalid = streaming.ask("status")["sensors"][0]["invalid"]
    changed = streaming.ask("configure", settings=IN_OP)
    assert changed["ok"]
    assert changed["settings"].items() >= IN_OP.items()
    assert streaming.described()["settings"] == changed["settings"]
    assert streaming.listener.wait_event("reconfigured")["settings"] == changed["settings"]
    assert streaming.ask("status")["sensors"][0]["invalid"] == invalid
    check_frames(streaming.frames)


def test_filters_are_changed_by_way_of_preop_and_the_stream_goes_on(streaming: Bench) -> None:
    listener = streaming.listener
    listener.fresh(100)
    changed = streaming.ask("configure", settings={"sinc_length": 128, "fir": True})
    assert changed["ok"], changed
    assert (changed["rate_hz"], changed["settings"]["fir"]) == (400, True)
    frames = listener.collect(400)
    assert [f.sequence for f in frames] == list(range(frames[0].sequence, frames[0].sequence + 400))
    last = [f for f in frames if not f.flags & (DataFlag.INVALID | DataFlag.REPEATED)][-100:]
    assert (last[-1].monotonic_ns - last[0].monotonic_ns) / 99 == pytest.approx(2.5e6, rel=0.02)
    described = streaming.described()
    assert (described["state"], described["rate_hz"]) == ("OP", 400)
    assert described["meaning"]["sinc_length"].startswith("400 Hz; cut-off 105 Hz")
    assert [event["event"] for event in listener.events] == ["reconfigured"]


def test_every_choice_of_every_setting_takes(shared: Bench) -> None:
    for name, setting in SETTINGS.items():
        default = shared.described()["settings"][name]
        choices = tuple(setting.choices)
        for value in (*(FORCE_TORQUE_FILTERS if name == "sinc_length" else choices), default):
            asked = {"fir": True, name: value} if name == "fast" else {name: value}
            changed = shared.ask("configure", settings=asked)
            assert changed["settings"][name] == value, changed
            row = shared.described()
            assert row["meaning"][name] == value_meaning(name, value)
            if name == "sinc_length":
                rate_hz = FORCE_TORQUE_FILTERS[value].rate_hz
                assert changed["rate_hz"] == row["rate_hz"] == rate_hz
                assert shared.ask("sdo_read", name="Sampling rate")["value"] == rate_hz
    assert shared.ask("configure", settings={"fir": False})["ok"]


def test_what_was_configured_and_tared_outlives_server_and_power_cut(bench: Bench) -> None:
    assert bench.ask("configure", settings={"sinc_length": 128})["ok"]
    tared = tare_at_rest(bench)["new_offset"]
    bench = bench.start_again(wanted=asked(keep_unset=True))
    bench.command("power cycle 0.2")
    bench.listener.wait_event("sensor_lost")
    assert bench.refused("sdo_read", index=RATE)["code"] == "not_ready"
    bench.listener.wait_event("sensor_back")
    assert bench.described()["settings"]["sinc_length"] == 128
    assert offset(bench) == pytest.approx(tared)


def test_a_sensor_does_one_change_at_a_time(bench: Bench) -> None:
    """Also while a change by way of PREOP keeps it out of OP."""
    other = bench.connect()
    tare = bench.asking.send("tare", samples=200)
    other.ask("describe")
    assert other.refused("configure", settings={"fir": True})["code"] == "busy"
    assert other.refused("tare")["code"] == "busy"
    assert other.ask("sdo_read", index=RATE)["ok"], "reading is no change"
    assert bench.asking.reply(tare)["ok"]
    # The sensor swallows what asks it for its settings, so it stays out of OP until the change fails.
    bench.command("on-write 0x8006 2 mute-mailbox 100000")
    bench.asking.send("configure", settings={"fir": True})
    bench.run_until(lambda: not bench.sensors[0].streams, "the sensor out of OP")
    assert other.described()["state"] == "PREOP"
    for action, keys in (("configure", {"settings": {"imu_active": 3}}), ("tare", {"samples": 20})):
        assert other.refused(action, **keys)["code"] == "busy"
    assert other.refused("sdo_read", index=RATE)["code"] == "not_ready"


def test_a_long_job_of_one_sensor_does_not_hold_up_those_of_another() -> None:
    bench = Bench(AT_REST, SensorOptions(signal="rest", serial=2, last_bit=False))
    tare = bench.asking.send("tare", sensor=0, samples=400)
    assert bench.connect().ask("sdo_read", sensor=1, index=RATE)["ok"]
    assert bench.asking.replies == []
    assert bench.asking.reply(tare)["ok"]


# -- what `describe` says of settings: cheap for one sensor, and never more than a message may have


def wordiest() -> dict[str, SettingValue]:
    """Of each setting the value that takes the most words."""
    return {
        name: max(
            setting.choices,
            key=lambda value, name=name: len(value_meaning(name, value)),
        )
        for name, setting in SETTINGS.items()
    }


def describe(count: int) -> JsonObject:
    sensors = [Sensor(n, Identity("B" * 20, 2**32 - 1, "H" * 12, "F" * 13), {}) for n in range(count)]
    for sensor in sensors:
        sensor.set_in_force(wordiest())

    class OnSensors:
        handlers: dict[str, object] = {}  # noqa: RUF012

    OnSensors.sensors = sensors  # type: ignore[attr-defined]
    actions = Actions(cast(Hub, None), cast(Cycle, None), cast(SensorActions, OnSensors()))
    reply = actions.handle(cast(Connection, None), {"action": "describe", "id": "i" * 4000})
    assert reply is not None
    return reply


@pytest.mark.parametrize("count", [1, 16, 32, 33, 100])
def test_a_reply_never_outgrows_a_message(count: int) -> None:
    reply = describe(count)
    assert len(reply["sensors"]) == count
    assert len(encode_json(reply)) <= MAX_JSON_LENGTH
    assert all(("meaning" in row) == (count <= 32) for row in reply["sensors"])


def test_a_server_names_the_clock_of_its_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    assert describe(1)["boot_id"] == boot_id()
    monkeypatch.setattr("ethercat_server.serving.actions.boot_id", lambda: None)
    assert "boot_id" not in describe(1)


# -- CHOP may divide the sampling rate, which object 0x8011 then says: everything follows the true rate

HALVED = SensorOptions(signal="clock", ppm=80.0, chop_divides=2)


def check_halved(simulation: Simulation) -> None:
    """Every sample comes, 2.5 ms apart."""
    (sensor,) = simulation.sensors
    assert (sensor.rate_hz, sensor.period_ns) == (400, 2.5e6)
    row = sensor.describe()
    assert row["settings"]["sinc_length"] == 64
    assert row["meaning"]["sinc_length"] == "400 Hz (CHOP divides 800 Hz by 2); cut-off not in the table"
    simulation.frames.clear()
    simulation.run(2.0)
    numbers = [reading(frame).number for frame in fresh(simulation.frames)[1:]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) == pytest.approx(800, abs=10)
    clock = simulation.status()["sensors"][0]["clock"]
    assert clock["mode"] == "locked"
    assert clock["period_us"] == pytest.approx(2500, rel=1e-3)
    check_frames(simulation.frames)


def test_a_sensor_whose_chop_divides_its_rate_starts_and_comes_back(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        simulation = Simulation(HALVED, settings={"chop": True})
    assert "sensor 0 samples at 400 Hz: CHOP divides the 800 Hz of sinc_length 64 by 2" in caplog.messages
    check_halved(simulation)
    simulation.command("power cycle 0.2")
    simulation.run_until(lambda: simulation.events and simulation.sensors[0].streams, "it is back")
    back = simulation.events[-1]
    assert (back["event"], back["rate_hz"]) == ("sensor_back", 400)
    check_halved(simulation)


def test_chop_is_switched_on_and_off_while_it_streams() -> None:
    bench = Bench(HALVED)
    for chop, rate_hz in ((True, 400), (False, 800)):
        changed = bench.ask("configure", settings={"chop": chop})
        assert (changed["ok"], changed["rate_hz"]) == (True, rate_hz)
        told = bench.listener.wait_event("reconfigured")
        assert (told["settings"]["chop"], told["rate_hz"]) == (chop, rate_hz)
        assert bench.described()["rate_hz"] == rate_hz
        if chop:
            check_halved(bench)


def test_a_rate_that_chop_does_not_explain_is_refused() -> None:
    refused = Bench(SensorOptions(chop_divides=9)).refused("configure", settings={"chop": True})
    assert "samples at 89 Hz, but sinc_length 64 implies 800 Hz" in refused["message"]
    assert refused["message"].endswith("the former settings are in force")


def test_a_longer_sinc_is_not_taken_for_a_chop_that_divides() -> None:
    simulation = Simulation(SensorOptions(signal="clock", sinc_length=128), settings={"chop": True})
    assert simulation.stats()["sinc_length"] == 64
    assert simulation.sensors[0].rate_hz == 800


def test_the_lowest_rate_settles_for_eight_samples() -> None:
    options = SensorOptions(signal="clock", chop_divides=8)
    simulation = Simulation(options, settings={"chop": True, "sinc_length": 2048})
    (sensor,) = simulation.sensors
    assert (sensor.rate_hz, sensor.period_ns) == (3, 320e6)
    began_ns = simulation.clock.now_ns
    simulation.run_until(lambda: not sensor.settling, "settled")
    assert (simulation.clock.now_ns - began_ns) * 1e-9 == pytest.approx(8 * 0.32, abs=0.4)


# -- tare


def tare_at_rest(bench: Bench, **keys: object) -> dict[str, Any]:
    tared = bench.ask("tare", samples=200, **keys)
    assert tared["ok"], tared
    assert max(map(abs, tared["residual"])) < 1e-5
    return tared


def test_tare_makes_the_mean_the_target(bench: Bench) -> None:
    target = [10.0, -20.0, 30.0, 1.0, 2.0, -3.0]
    tared, again = tare_at_rest(bench, target=target), tare_at_rest(bench)
    for before, after, wanted in zip(tared["new_offset"], again["new_offset"], target, strict=True):
        assert after == pytest.approx(before - wanted, abs=1e-5)
    assert offset(bench) == pytest.approx(again["new_offset"], rel=1e-6)
    assert len(bench.listener.fresh(50)) == 50


@pytest.mark.parametrize("bit", range(7))
def test_a_sensor_that_says_that_it_must_not_be_used_is_not_tared(bench: Bench, bit: int) -> None:
    """By the warnings register alone; of an overtemperature, and of the accelerometer, all the same."""
    bench.command(f"warn {1 << bit}")
    if bit in (1, 5):
        tare_at_rest(bench)
        return
    refused = bench.refused("tare", samples=200)
    assert refused["code"] == "not_ready"
    assert re.match("sensor 0 cannot be tared: (force or torque|angular rate) was ", refused["message"])
    assert offset(bench) == [0.0] * 6


def test_a_tare_that_made_it_worse_is_taken_back(bench: Bench) -> None:
    tared = tare_at_rest(bench)["new_offset"]
    bench.command("on-write 0x8000 1 signal poses")  # another load from here on
    refused = bench.refused("tare", samples=50)
    assert refused["code"] == "not_ready"
    assert re.search("(N|Nm) off target after it and was 0 before", refused["message"])
    assert refused["message"].endswith("; the old offset is in force")
    assert offset(bench) == tared
    bench.command("power cycle 0.2")
    bench.listener.wait_event("sensor_back")
    assert offset(bench) == tared, "it outlives a power cut too"


def test_a_change_of_the_offset_is_told_at_once(bench: Bench) -> None:
    def told() -> Any:
        assert bench.listener.wait_event("offset_changed")["offset"] is None, "before the first is written"
        return bench.listener.wait_event("offset_changed")["offset"]

    assert bench.described()["offset"] == [0.0] * 6
    new = tare_at_rest(bench)["new_offset"]
    event = bench.listener.wait_event("offset_changed")
    assert event == {"event": "offset_changed", "sensor": 0, "offset": None}
    event = bench.listener.wait_event("offset_changed")
    assert event == {"event": "offset_changed", "sensor": 0, "offset": new}
    assert bench.described()["offset"] == new
    assert bench.ask("sdo_write", index=OFFSET, subindex=3, type="f32", value=1.5)["ok"]
    changed = [*new[:2], 1.5, *new[3:]]
    assert told() == bench.described()["offset"] == changed
    bench.command("on-write 0x8000 1 signal poses")  # the tare is taken back
    assert not bench.ask("tare", samples=50)["ok"]
    assert told() != changed
    assert told() == bench.described()["offset"] == changed


def test_a_refused_offset_is_refused_for_its_own_reason(bench: Bench) -> None:
    """Also where it cannot be read back: then it is not known, until it is written."""
    bench.command("abort 0x8000 2 0x06010000")
    bench.command("abort 0x8000 1 0x08000021")
    refused = bench.refused("sdo_write", index=OFFSET, subindex=2, type="f32", value=1.5)
    assert (refused["code"], refused["abort_code"]) == ("sensor", 0x06010000)
    assert bench.described()["offset"] is None
    assert bench.ask("sdo_write", index=OFFSET, subindex=2, type="f32", value=2.5)["ok"]
    assert bench.described()["offset"] == [0.0, 2.5, 0.0, 0.0, 0.0, 0.0]


def test_a_tare_has_the_time_that_its_samples_take() -> None:
    """At the lowest rate, too."""
    bench = Bench(settings={"sinc_length": 2048})
    assert bench.described()["rate_hz"] == 25
    assert bench.ask("tare", samples=100)["ok"]


# -- for half a second after a sensor has entered OP its data settles: the stream does not wait, a tare does


def settling(bench: Bench, sensor: int = 0) -> bool:
    """What `describe` and `status` say."""
    before, now = (bench.ask(action)["sensors"][sensor]["settling"] for action in ("describe", "status"))
    assert isinstance(now, bool)
    assert before in (now, True), "it may have ended between the two questions"
    return now


def settles(bench: Bench) -> float:
    """How long it goes on from now, s."""
    began_ns = bench.clock.now_ns
    while settling(bench):
        bench.run(0.004)
    return (bench.clock.now_ns - began_ns) * 1e-9


def test_a_sensor_settles_after_each_entry_into_op(bench: Bench) -> None:
    assert 0.4 < settles(bench) < 0.51, "the server has started"
    bench.command("power cycle 0.2")
    bench.listener.wait_event("sensor_lost")
    assert not settling(bench), "it gives no data"
    bench.listener.wait_event("sensor_back")
    assert len(bench.listener.fresh(20)) == 20
    assert 0.4 < settles(bench) < 0.51, "its samples came at once"
    assert bench.ask("configure", settings={"fir": True})["ok"]
    assert 0.4 < settles(bench) < 0.51
    assert bench.ask("configure", settings={"imu_active": 3})["ok"]
    assert not settling(bench), "it did not leave OP"
    bench.command("deaf 0.07")
    bench.listener.wait_event("sensor_back")
    assert not settling(bench), "it did not leave OP either"


@pytest.mark.parametrize("change", ["start", "recovery", "configure"])
def test_a_tare_waits_for_settled_data(bench: Bench, change: str) -> None:
    if change != "start":
        bench.run(0.6)
    if change == "recovery":
        bench.command("power cycle 0.2")
        bench.listener.wait_event("sensor_back")
    elif change == "configure":
        assert bench.ask("configure", settings={"fir": True})["ok"]
    bench.command("limit force.z 5")  # it has not settled
    bench.at(0.3, "limit force.z off")
    assert bench.ask("tare", samples=50)["new_offset"][2] == pytest.approx(9.75)


def test_a_sensor_that_is_lost_while_a_tare_waits_for_it_is_not_tared(bench: Bench) -> None:
    bench.command("power cycle 0.2")
    refused = bench.refused("tare", samples=50)
    assert (refused["code"], "is lost" in refused["message"]) == ("not_ready", True)
    assert "0x8000" not in [index for index, _, _ in bench.written()]


# -- what fails or is cut off half way


def moments(step_ms: int, count: int) -> list[Any]:
    """In ms; every tenth one, and all of them with --long."""
    every = range(0, count * step_ms, step_ms)
    return more_if_long(every[1::10], every)


def check_former(bench: Bench, before: dict[str, Any]) -> None:
    """The server says that the former settings are in force, the sensor holds them, and samples come."""
    assert len(bench.listener.fresh(50)) == 50
    now = bench.described()
    assert (now["settings"], now["rate_hz"], now["state"]) == (before["settings"], before["rate_hz"], "OP")
    assert (held(bench, CONFIGURATION, 2), held(bench, CONFIGURATION, 3), held(bench, FILTERS, 4)) == (
        0,
        1,
        0,
    )
    assert bench.ask("sdo_read", index=RATE, type="u16")["value"] == 800


@pytest.mark.parametrize(
    ("settings", "what", "said"),
    [
        (IN_OP, f"abort 0x8010 3 {ABORT}", "imu_active = 3 did not take"),
        # It took, but cannot be read back.
        (IN_OP, f"on-write 0x8010 3 abort 0x8010 3 {ABORT}", "imu_active = 3 did not take"),
        (BY_PREOP, f"abort 0x8006 1 {ABORT}", "sinc_length = 128 did not take"),
    ],
)
def test_an_abort_half_way(bench: Bench, settings: dict[str, Any], what: str, said: str) -> None:
    before = bench.described()
    bench.command(what)
    refused = bench.refused("configure", settings=settings)
    assert (refused["code"], refused["abort_code"]) == ("sensor", int(ABORT, 16))
    assert said in refused["message"]
    assert refused["message"].endswith("; the former settings are in force")
    check_former(bench, before)
    assert {event["event"] for event in bench.listener.events} <= {"reconfigured"}


@pytest.mark.parametrize(
    ("settings", "when", "fault"),
    [
        (IN_OP, "0x8010 2", "power cycle 0.3"),
        (IN_OP, "0x8010 2", "deaf 0.4"),
        (BY_PREOP, "0x8006 4", "power cycle 0.3"),
        (BY_PREOP, "0x8006 4", "deaf 2.5"),
    ],
)
def test_a_sensor_lost_half_way_comes_back_with_its_former_settings(
    bench: Bench, settings: dict[str, Any], when: str, fault: str
) -> None:
    before = bench.described()
    bench.command(f"on-write {when} {fault}")
    refused = bench.refused("configure", settings=settings)
    assert refused["code"] == "not_ready"
    assert refused["message"].endswith("; it gets its former settings when it is back")
    bench.listener.wait_event("sensor_lost")
    assert bench.listener.wait_event("sensor_back")["settings"] == before["settings"]
    check_former(bench, before)
    assert bench.ask("configure", settings=settings)["ok"], "the next one takes"


@pytest.mark.parametrize("comes_back", [False, True])
def test_putting_back_the_former_settings_fails_too_in_op(bench: Bench, comes_back: bool) -> None:
    """It is put back when the sensor comes back."""
    before = bench.described()
    bench.command(f"abort 0x8010 3 {ABORT}")
    bench.command("on-write 0x8010 3 abort 0x8010 2 0x08000022")
    said = bench.refused("configure", settings=IN_OP)["message"]
    assert "imu_active = 3 did not take" in said
    assert "; restoring the former settings failed too: the setting temperature_compensation" in said
    assert said.endswith("; configure it again")
    assert held(bench, CONFIGURATION, 2) == 1, "so it is"
    if comes_back:
        bench.command("deaf 0.3")
        bench.listener.wait_event("sensor_back")
        check_former(bench, before)
    again = bench.ask("configure", settings={"temperature_compensation": True, "imu_active": 2})
    assert again["ok"], again
    assert (held(bench, CONFIGURATION, 2), held(bench, CONFIGURATION, 3)) == (1, 2)


def test_putting_back_the_former_settings_fails_too_by_way_of_preop(bench: Bench) -> None:
    before = bench.described()
    bench.command(f"abort 0x8006 1 {ABORT}")
    bench.command("on-write 0x8006 1 abort 0x8006 1 0x08000022")
    said = bench.refused("configure", settings=BY_PREOP)["message"]
    assert "; restoring the former settings failed too: " in said
    assert said.endswith("; it gets its former settings when it is back")
    bench.listener.wait_event("sensor_back")
    check_former(bench, before)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("power cycle 0.3", "; it gets its old offset when it is back"),
        ("deaf 0.4", "; it gets its old offset when it is back"),
        (f"abort 0x8000 5 {ABORT}", "; the old offset is in force"),
    ],
)
def test_a_tare_cut_off_half_way_leaves_the_old_offset(bench: Bench, fault: str, said: str) -> None:
    first = bench.ask("tare", samples=20, target=FX_5)
    assert first["ok"], first
    bench.listener.events.clear()
    bench.command(f"on-write 0x8000 3 {fault}")
    refused = bench.refused("tare", samples=20, target=[0, 0, 0, 1, 1, 1])
    assert refused["message"].endswith(said), refused
    if "back" in said:
        bench.listener.wait_event("sensor_back")
    assert offset(bench) == pytest.approx(first["new_offset"])
    again = bench.ask("tare", samples=20, target=FX_5)
    assert again["ok"], again
    assert again["old_offset"] == pytest.approx(first["new_offset"])


def test_a_save_that_ends_with_a_status_is_no_success(bench: Bench) -> None:
    bench.command(f"abort 0x8030 1 {ABORT}")
    said = bench.refused("configure", settings={"imu_active": 3}, save=True)["message"]
    assert said.endswith("; its settings are in force until its power goes, but not saved")
    assert bench.described()["settings"]["imu_active"] == 3
    bench.listener.fresh(400)
    bench.command("saving 0 7")
    said = bench.refused("configure", settings={"imu_active": 1}, save=True)["message"]
    assert "did not save its settings (status 7): they are in force until" in said
    bench.command("saving 0.3")
    saved = bench.ask("configure", settings={"imu_active": 3}, save=True)
    assert saved["ok"], saved
    assert saved["saved"] is True


def test_a_power_cut_during_save_is_met_at_the_start(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    """FIR, SINC 128, CHOP and an offset are in force; the power goes after FIR was saved, before CHOP.

    The flash has 0x8000 to 0x8006:3 new, the rest old: a mixture that nobody asked for.
    """
    caplog.set_level("INFO")
    assert bench.ask("tare", samples=20, target=FX_5)["new_offset"][0] == 3.5
    assert bench.ask("configure", settings={"fir": True, "sinc_length": 128, "chop": True})["ok"]
    bench.command("cut-save 27")
    refused = bench.refused("configure", settings={"fir": True}, save=True)
    assert refused["code"] == "not_ready"
    assert "whether it saved all, some or none of its settings is not known" in refused["message"]
    bench.command("power on")
    caplog.clear()
    bench = bench.start_again()
    said = caplog.text
    assert "sensor 0 held fir = true (wanted: false)" in said, said
    assert "a sampling rate of 400 Hz (wanted: 800 Hz)" in said
    assert "chop" not in said, "its turn had not come"
    assert "sensor 0 has a tare in force (saved or not): Fx offset 3.5 N" in said
    found = bench.described()
    assert (found["state"], found["rate_hz"]) == ("OP", 800)
    assert found["settings"].items() >= {"fir": False, "chop": False, "sinc_length": 64}.items()
    caplog.clear()
    bench.start_again()
    assert " held " not in caplog.text, "now it holds what is wanted"


@pytest.mark.parametrize("after", moments(2, 30))
def test_lost_at_any_moment_of_a_change_it_has_former_or_new_settings(bench: Bench, after: int) -> None:
    """The power goes `after` ms into the change; what the reply says is what is in force."""
    before = bench.described()["settings"]
    number = bench.asking.send("configure", settings=BY_PREOP)
    bench.at(after * 1e-3, "power cycle 0.2")
    reply = bench.asking.reply(number)
    bench.run(0.5)
    found = bench.described()
    assert found["state"] == "OP"
    assert found["settings"] == (reply["settings"] if reply["ok"] else before)
    assert held(bench, FILTERS, 4) == found["settings"]["chop"]
    assert len(bench.listener.fresh(50)) == 50
    assert bench.ask("configure", settings=BY_PREOP)["ok"], "the next one takes"


@pytest.mark.parametrize("after", moments(3, 30))
def test_lost_at_any_moment_of_a_tare_it_has_the_old_or_new_offset(bench: Bench, after: int) -> None:
    """The power goes `after` ms into the tare; what the reply says is what is in force."""
    number = bench.asking.send("tare", samples=20, target=FX_5)
    bench.at(after * 1e-3, "power cycle 0.2")
    reply = bench.asking.reply(number)
    bench.run(0.5)
    assert offset(bench) == pytest.approx(reply["new_offset"] if reply["ok"] else [0.0] * 6)


def test_a_change_that_somebody_asked_for_is_not_logged_as_one_that_had_to_be_put_right(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    assert bench.ask("configure", settings={"sinc_length": 32, "fir": True})["ok"]
    (line,) = [
        line
        for line in caplog.messages
        if "1600 Hz" in line and "sensor 0 was changed as requested: " in line
    ]
    assert "fir = true (was false)" in line
    assert "a sampling rate of 1600 Hz (was 800 Hz)" in line
    assert " held " not in caplog.text
    # Without what was not saved it is put right, and that is said.
    bench.command("power cycle 0.2")
    bench.run(1.0)
    assert "sensor 0 held fir = false (wanted: true), a sampling rate of 800 Hz" in caplog.text


# -- a server that is started again


@pytest.fixture
def saved(bench: Bench, caplog: pytest.LogCaptureFixture) -> Bench:
    """A sensor whose settings somebody saved, and that was powered off since."""
    caplog.set_level("INFO")
    assert bench.ask("configure", settings={"sinc_length": 51, "fir": True}, save=True)["ok"]
    bench.close()
    bench.command("power off")
    bench.command("power on")
    return bench


def in_force(bench: Bench) -> tuple[int, bool, int]:
    row = bench.described()
    return row["settings"]["sinc_length"], row["settings"]["fir"], row["rate_hz"]


def test_a_start_overwrites_what_was_saved_and_says_so(
    saved: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    assert in_force(Bench(backend=saved.backend)) == (64, False, 800)
    (line,) = [line for line in caplog.messages if " held " in line]
    assert "a sampling rate of 1003 Hz (wanted: 800 Hz)" in line
    assert "nobody set fir, sinc_length: --unset-settings keep leaves what the sensor has" in line
    caplog.clear()
    saved.command("power cycle 0.1")
    saved.clock.sleep(0.2)
    Bench(backend=saved.backend, settings={"sinc_length": 64, "fir": False})
    assert " held " in caplog.text
    assert "nobody set" not in caplog.text, "somebody set them"


def test_unset_settings_are_kept_through_a_power_cut(saved: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(backend=saved.backend, wanted=asked({"fir": False}, keep_unset=True))
    assert in_force(bench) == (51, False, 1003)
    assert "sensor 0 keeps what nobody set: sinc_length = 51" in caplog.text
    assert "nobody set fir" not in caplog.text
    assert bench.ask("configure", settings={"imu_active": 0})["ok"]
    bench.command("power cycle 0.3")
    bench.listener.wait_event("sensor_back")
    assert in_force(bench) == (51, False, 1003)
    assert len(bench.listener.fresh(50)) == 50


def test_kept_settings_that_contradict_those_set_end_the_start(bench: Bench) -> None:
    with pytest.raises(BusError, match="contradict those set: fast is true but fir is false"):
        bench.start_again(wanted=asked({"fast": True}, keep_unset=True))


def test_a_fresh_sensor_has_nothing_to_keep_but_the_defaults(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    assert in_force(Bench(wanted=asked(keep_unset=True))) == (64, False, 800)
    assert "sensor 0 keeps what nobody set: the defaults" in caplog.text
