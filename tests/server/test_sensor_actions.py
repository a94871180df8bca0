"""Settings, SDO access and tare through the control channel while the sensor streams, in simulated time."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest

from bota_ethercat.framing import DataFlag, encode_json
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.bench import AT_REST, Bench, error
from tests.simulation import Client, check_frames, reading

RATE, FILTERS, OFFSET, CALIBRATION = 0x8011, 0x8006, 0x8000, 0x2000


@pytest.fixture
def streaming() -> tuple[Bench, Client, Client]:
    """A sensor whose samples are numbered, a client that listens and one that asks."""
    bench = Bench(SensorOptions(signal="clock", ppm=150.0))
    return bench, bench.client, bench.asking


@pytest.fixture(scope="module")
def refusing() -> Client:
    """One that asks for what is refused, so that the sensor stays as it is."""
    return Bench().asking


@pytest.fixture
def bench() -> tuple[Bench, Client]:
    """A stationary sensor, and two clients: one that listens, one that asks."""
    found = Bench(AT_REST)
    return found, found.asking


def test_objects_are_read_by_index_in_any_notation(streaming: tuple[Bench, Client, Client]) -> None:
    _, _, asking = streaming
    assert asking.ask("sdo_read", index=RATE, type="u16")["value"] == 800
    assert asking.ask("sdo_read", index="0x8011", subindex=0, sensor=0)["hex"] == "2003"
    assert asking.ask("sdo_read", index="0x1008", type="string")["value"] == "BFT-SENS-ECAT-M8"
    refused = error(asking.ask("sdo_read", index=0x8003))
    assert (refused["code"], refused["abort_code"]) == ("sensor", 0x06020000)
    assert error(asking.ask("sdo_read", index=RATE, type="f32"))["code"] == "bad_request"
    assert error(asking.ask("sdo_read", index=RATE, sensor=3))["code"] == "bad_request"


def test_objects_are_read_by_name(streaming: tuple[Bench, Client, Client]) -> None:
    _, _, asking = streaming
    rate = asking.ask("sdo_read", name="Sampling Rate")
    assert (rate["index"], rate["subindex"], rate["type"], rate["value"]) == (RATE, 0, "u16", 800)
    assert asking.ask("sdo_read", name="sinc_length")["value"] == 384, "not what was written"
    imu = asking.ask("sdo_read", name="IMU active")
    assert (imu["type"], imu["value"]) == ("u8", 1)
    assert asking.ask("sdo_read", name="control status")["name"] == "Control Status"
    assert asking.ask("sdo_read", name="Device name")["value"] == "BFT-SENS-ECAT-M8"
    assert asking.ask("sdo_read", name="FIR disable", type="bool")["value"] is True
    for name, said in (
        ("Status", "2 objects: Measurement Status, Control Status"),
        ("Calibration", "88 objects: "),
        ("colour", "no object's"),
        ("", "a text of 1 to 80 characters"),
        ("x" * 81, "a text of 1 to 80 characters"),
    ):
        refused = error(asking.ask("sdo_read", name=name))
        assert refused["code"] == "bad_request"
        assert said in refused["message"]
    both = error(asking.ask("sdo_read", name="Sampling rate", subindex=0))
    assert (both["code"], "'subindex'" in both["message"]) == ("bad_request", True)
    for keys in ({}, {"index": RATE, "name": "Sampling rate"}):
        assert "needs either the key 'index' or" in error(asking.ask("sdo_read", **keys))["message"]


def test_the_eeprom_is_read_and_the_stream_goes_on(streaming: tuple[Bench, Client, Client]) -> None:
    _, listener, asking = streaming
    assert asking.ask("sii_read", word=8)["hex"] == "7ab00000"
    image = bytes.fromhex(asking.ask("sii_read", word="0x0", words=128)["hex"])
    assert (len(image), image[16:20]) == (256, b"\x7a\xb0\0\0")
    assert asking.ask("sii_read", word=9, words=1)["hex"] == "0000"
    for keys in ({}, {"word": -1}, {"word": 65536}, {"word": 0, "words": 0}, {"word": 0, "words": 129}):
        assert error(asking.ask("sii_read", **keys))["code"] == "bad_request"
    assert len(listener.fresh(100)) == 100
    assert not [event for event in listener.events if event["event"] != "reconfigured"]


def test_objects_are_written_but_never_the_factory_calibration(
    streaming: tuple[Bench, Client, Client],
) -> None:
    _, _, asking = streaming
    assert asking.ask("sdo_write", index=OFFSET, subindex=2, type="f32", value=1.5)["ok"]
    assert asking.ask("sdo_read", index=OFFSET, subindex=2, type="f32")["value"] == 1.5
    assert asking.ask("sdo_write", index=OFFSET, subindex=2, hex="00000000")["ok"]
    assert asking.ask("sdo_read", index=OFFSET, subindex=2, type="f32")["value"] == 0
    before = asking.ask("sdo_read", index=CALIBRATION, subindex=1)["hex"]
    for notation in (CALIBRATION, "0x2000", "8192"):
        refused = error(asking.ask("sdo_write", index=notation, subindex=1, type="f32", value=2.5))
        assert refused["code"] == "denied"
    assert asking.ask("sdo_read", index=CALIBRATION, subindex=1)["hex"] == before
    refused = error(asking.ask("sdo_write", index=FILTERS, subindex=1, type="u16", value=128))
    assert (refused["code"], refused["abort_code"]) == ("sensor", 0x08000022), "in PREOP only"


def test_a_setting_that_is_written_as_an_object_is_told_to_all(
    streaming: tuple[Bench, Client, Client],
) -> None:
    _, _, asking = streaming
    for value in (0, 0, 1):
        assert asking.ask("sdo_write", index=0x8010, subindex=1, type="u8", value=value)["ok"]
    assert asking.ask("sdo_write", index=OFFSET, subindex=2, type="f32", value=1.5)["ok"], "no setting"
    assert asking.ask("configure", settings={"imu_active": 3})["ok"]
    told = [event["settings"] for event in asking.events if event["event"] == "reconfigured"]
    matrix_and_imu = [(settings["calibration_matrix"], settings["imu_active"]) for settings in told]
    assert matrix_and_imu == [(False, 1), (True, 1), (True, 3)]


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"index": OFFSET}, "either the keys 'type' and 'value' or the key 'hex'"),
        ({"index": OFFSET, "type": "f32"}, "either"),
        ({"index": OFFSET, "type": "f32", "value": 1, "hex": "00"}, "either"),
        ({"index": OFFSET, "type": "u8", "value": 256}, "'value' must be a number that is a u8"),
        ({"index": OFFSET, "type": "u8", "value": "1"}, "'value'"),
        ({"index": OFFSET, "type": "quaternion", "value": 1}, "'type' must be one of bool, i8"),
        ({"index": OFFSET, "hex": "0"}, "'hex'"),
        ({"index": OFFSET, "hex": "00" * 113}, "'hex' must be 1 to 112 bytes"),
        ({"index": 0x1008, "type": "string", "value": "x" * 113}, "'value' must be 1 to 112 bytes"),
        ({"index": 0x1008, "type": "string", "value": ""}, "'value' must be 1 to 112 bytes"),
        ({"index": 65536, "hex": "00"}, "'index'"),
        ({"index": OFFSET, "subindex": -1, "hex": "00"}, "'subindex'"),
        ({"hex": "00"}, "needs the key 'index'"),
    ],
)
def test_a_bad_request_names_the_key(refusing: Client, keys: dict[str, object], named: str) -> None:
    refused = error(refusing.ask("sdo_write", **keys))
    assert refused["code"] == "bad_request"
    assert named in refused["message"]


def test_requests_behind_a_slow_one_are_answered_in_order(streaming: tuple[Bench, Client, Client]) -> None:
    _, _, asking = streaming
    requests = [{"action": "sdo_read", "index": "0x1008", "id": 0}, {"action": "describe", "id": 1}]
    requests += [{"action": "sdo_read", "index": RATE, "id": n} for n in range(2, 40)]
    asking.replies.clear()
    asking.stream.send(b"".join(encode_json(request) for request in requests))
    asking.reply(39)
    assert [reply["id"] for reply in asking.replies] == list(range(40))


def test_a_setting_that_any_state_takes_is_changed_without_a_pause(
    streaming: tuple[Bench, Client, Client],
) -> None:
    bench, listener, asking = streaming
    listener.fresh(100)
    invalid = asking.ask("status")["sensors"][0]["invalid"]
    changed = asking.ask("configure", settings={"temperature_compensation": True, "imu_active": 3})
    assert changed["ok"]
    assert changed["settings"]["temperature_compensation"] is True
    assert changed["settings"]["imu_active"] == 3
    assert asking.ask("describe")["sensors"][0]["settings"] == changed["settings"]
    assert listener.wait_event("reconfigured")["settings"] == changed["settings"]
    status = asking.ask("status")
    assert status["sensors"][0]["invalid"] == invalid
    check_frames(bench.simulation.frames)


def test_filters_are_changed_by_way_of_preop_and_the_stream_goes_on(
    streaming: tuple[Bench, Client, Client],
) -> None:
    _, listener, asking = streaming
    listener.fresh(100)
    changed = asking.ask("configure", settings={"sinc_length": 128, "fir": True})
    assert changed["ok"], changed
    assert (changed["rate_hz"], changed["settings"]["fir"]) == (400, True)
    frames = listener.collect(400)
    assert [f.sequence for f in frames] == list(range(frames[0].sequence, frames[0].sequence + 400))
    last = [f for f in frames if not f.flags & (DataFlag.INVALID | DataFlag.REPEATED)][-100:]
    assert (last[-1].monotonic_ns - last[0].monotonic_ns) / 99 == pytest.approx(2.5e6, rel=0.02)
    described = asking.ask("describe")["sensors"][0]
    assert (described["state"], described["rate_hz"]) == ("OP", 400)
    assert described["meaning"]["sinc_length"].startswith("400 Hz; cut-off 105 Hz")
    assert not [event for event in listener.events if event["event"] != "reconfigured"]
    assert [event["event"] for event in listener.events].count("reconfigured") == 1


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({}, "an object with settings"),
        ({"sinc_length": 0}, "sinc_length is 0"),
        ({"colour": 1}, "no setting 'colour'"),
        ({"fast": True}, "fast is true but fir is false"),
        ({"fir": 1}, "fir is 1"),
        ({"sinc_length": 128, "acceleration_range_g": 3}, "acceleration_range_g is 3"),
    ],
)
def test_wrong_settings_are_refused_whole(refusing: Client, settings: dict[str, object], named: str) -> None:
    before = refusing.ask("describe")["sensors"]
    refused = error(refusing.ask("configure", settings=settings))
    assert refused["code"] == "bad_request"
    assert named in refused["message"]
    assert refusing.ask("describe")["sensors"] == before


def test_a_change_that_fails_half_way_is_taken_back(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    before = asking.ask("describe")["sensors"][0]["settings"]
    # Both in OP: the second write is refused.
    sensor.command("abort 0x8010 3 0x08000021")
    refused = error(asking.ask("configure", settings={"temperature_compensation": True, "imu_active": 3}))
    assert (refused["code"], refused["abort_code"]) == ("sensor", 0x08000021)
    assert "imu_active" in refused["message"]
    # By way of PREOP: the sensor is brought back with what was in force.
    sensor.command("abort 0x8006 1 0x08000021")
    refused = error(asking.ask("configure", settings={"chop": True, "sinc_length": 128}))
    assert refused["code"] == "sensor"
    assert "the former settings are in force" in refused["message"]
    described = asking.ask("describe")["sensors"][0]
    assert (described["settings"], described["state"]) == (before, "OP")
    assert asking.ask("sdo_read", index=0x8010, subindex=2, type="u8")["value"] == 0
    assert asking.ask("sdo_read", index=0x8006, subindex=4, type="u8")["value"] == 0
    assert len(sensor.client.fresh(100)) == 100


def test_what_was_configured_and_tared_outlives_a_power_cut(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    assert asking.ask("configure", settings={"sinc_length": 128})["ok"]
    offset = tare_at_rest(asking)["new_offset"]
    sensor.client.fresh(50)
    sensor.client.events.clear()
    sensor.command("power cycle 0.2")
    sensor.wait_event("sensor_lost")
    assert error(asking.ask("sdo_read", index=RATE))["code"] == "not_ready"
    sensor.wait_event("sensor_back")
    assert asking.ask("describe")["sensors"][0]["settings"]["sinc_length"] == 128
    for position, value in enumerate(offset, 1):
        held = asking.ask("sdo_read", index=OFFSET, subindex=position, type="f32")["value"]
        assert held == pytest.approx(value)


def test_saved_settings_are_in_the_flash(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    assert asking.ask("configure", settings={"acceleration_range_g": 8}, save=True)["saved"] is True
    assert asking.ask("configure", settings={"acceleration_range_g": 8})["saved"] is False
    written = [(row["index"], row["subindex"], row["hex"]) for row in sensor.stats()["sdo_writes"]]
    assert ("0x8030", 1, "01") in written
    assert written.index(("0x8004", 0, "02")) < written.index(("0x8030", 1, "01"))


def tare_at_rest(asking: Client, **keys: object) -> dict[str, Any]:
    tared = asking.ask("tare", samples=200, **keys)
    assert tared["ok"], tared
    assert max(map(abs, tared["residual"])) < 1e-5
    return tared


def test_tare_makes_the_mean_the_target(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    target = [10.0, -20.0, 30.0, 1.0, 2.0, -3.0]
    tared = tare_at_rest(asking, target=target)
    again = tare_at_rest(asking)
    for before, after, wanted in zip(tared["new_offset"], again["new_offset"], target, strict=True):
        assert after == pytest.approx(before - wanted, abs=1e-5)
    for position, value in enumerate(again["new_offset"], 1):
        held = asking.ask("sdo_read", index=OFFSET, subindex=position, type="f32")["value"]
        assert held == pytest.approx(value, rel=1e-6)
    assert len(sensor.client.fresh(50)) == 50


def test_a_sensor_that_moves_is_not_tared(streaming: tuple[Bench, Client, Client]) -> None:
    _, _, asking = streaming
    refused = error(asking.ask("tare", samples=50))
    assert refused["code"] == "not_ready"
    assert "not at rest" in refused["message"]
    assert asking.ask("sdo_read", index=OFFSET, subindex=1, type="f32")["value"] == 0


def test_a_tare_that_made_it_worse_is_taken_back(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    offset = tare_at_rest(asking)["new_offset"]
    sensor.command("on-write 0x8000 1 limit force.z 9")  # the load is less from here on
    refused = error(asking.ask("tare", samples=50))
    assert refused["code"] == "not_ready"
    assert "Fz is 0.75 N off target after it and was 0 before" in refused["message"]
    assert refused["message"].endswith("; the old offset is in force")
    held = [asking.ask("sdo_read", index=OFFSET, subindex=sub, type="f32")["value"] for sub in range(1, 7)]
    assert held == offset
    sensor.command("limit force.z off")
    sensor.command("power cycle 0.2")
    sensor.wait_event("sensor_back")
    held = [asking.ask("sdo_read", index=OFFSET, subindex=sub, type="f32")["value"] for sub in range(1, 7)]
    assert held == offset, "it outlives a power cut too"


def test_a_change_of_the_offset_is_told_at_once(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench

    def described() -> Any:
        return asking.ask("describe")["sensors"][0]["offset"]

    assert described() == [0.0] * 6
    new = tare_at_rest(asking)["new_offset"]
    assert sensor.wait_event("offset_changed") == {"event": "offset_changed", "sensor": 0, "offset": new}
    assert described() == new
    assert asking.ask("sdo_write", index=OFFSET, subindex=3, type="f32", value=1.5)["ok"]
    changed = [*new[:2], 1.5, *new[3:]]
    assert sensor.wait_event("offset_changed")["offset"] == described() == changed
    sensor.command("on-write 0x8000 1 limit force.z 9")  # the tare is taken back
    assert not asking.ask("tare", samples=50)["ok"]
    assert sensor.wait_event("offset_changed")["offset"] != changed
    assert sensor.wait_event("offset_changed")["offset"] == described() == changed


def test_noise_does_not_make_a_tare_worse(bench: tuple[Bench, Client]) -> None:
    """It is on target already, so that each of these may be somewhat worse by chance."""
    sensor, asking = bench
    for channel, deviation in (("force.x", 0.5), ("force.z", 0.1), ("torque.y", 0.02)):
        sensor.command(f"noise {channel} {deviation}")
    for samples in (20, 200):
        for _ in range(15):
            tared = asking.ask("tare", samples=samples)
            assert tared["ok"], tared


def test_an_offset_that_no_sensor_can_hold_is_refused_before_anything_is_written(
    bench: tuple[Bench, Client],
) -> None:
    sensor, asking = bench
    for target in ([1e300, 0, 0, 0, 0, 0], [0, 0, -3.5e38, 0, 0, 0]):
        refused = error(asking.ask("tare", samples=20, target=target))
        assert refused["code"] == "bad_request"
        assert "'target' cannot be" in refused["message"]
    assert not [row for row in sensor.stats()["sdo_writes"] if row["index"] == "0x8000"]
    assert len(sensor.client.fresh(50)) == 50, "the stream goes on"
    assert asking.ask("tare", samples=20)["ok"]


def test_a_sensor_does_one_change_at_a_time(streaming: tuple[Bench, Client, Client]) -> None:
    bench, _, asking = streaming
    asking.send("tare", samples=200)
    other = bench.simulation.connect()
    other.ask("describe")
    assert error(other.ask("configure", settings={"fir": True}))["code"] == "busy"
    assert error(other.ask("tare"))["code"] == "busy"
    assert other.ask("sdo_read", index=RATE)["ok"], "reading is no change"


def test_a_change_by_way_of_preop_is_a_change_too(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    other = sensor.simulation.connect()
    # The sensor swallows what asks it for its settings, so it stays out of OP until the change fails.
    sensor.command("on-write 0x8006 2 mute-mailbox 100000")
    asking.send("configure", settings={"fir": True})
    sensor.simulation.run_until(lambda: not sensor.simulation.sensors[0].streams, "the sensor out of OP")
    assert other.ask("describe")["sensors"][0]["state"] == "PREOP"
    for action, keys in (("configure", {"settings": {"imu_active": 3}}), ("tare", {"samples": 20})):
        assert error(other.ask(action, **keys))["code"] == "busy"
    assert error(other.ask("sdo_read", index=RATE))["code"] == "not_ready"


def test_a_client_that_leaves_while_its_request_is_done_leaves_nothing_behind(
    streaming: tuple[Bench, Client, Client], caplog: pytest.LogCaptureFixture
) -> None:
    bench, _, asking = streaming
    for action, keys in (("sdo_read", {"index": "0x1008"}), ("tare", {"samples": 20})):
        other = bench.simulation.connect()
        other.send(action, **keys)
        bench.simulation.run(0.004)
        other.close()
    changed = asking.ask("configure", settings={"imu_active": 3})
    while not changed["ok"]:
        assert changed["error"]["code"] == "busy"
        changed = asking.ask("configure", settings={"imu_active": 3})
    bench.simulation.run(0.1)
    assert len(bench.simulation.hub.connections) == 2
    assert "Traceback" not in caplog.text


def test_sdo_traffic_costs_no_sample(streaming: tuple[Bench, Client, Client]) -> None:
    bench, listener, asking = streaming
    listener.fresh(800)
    before = asking.ask("status")["sensors"][0]
    listener.frames.clear()
    for _ in range(50):
        assert asking.ask("sdo_read", index=RATE)["ok"]
    after = asking.ask("status")["sensors"][0]
    numbers = [reading(frame).number for frame in listener.frames]
    assert all(two == one + 1 for one, two in pairwise(numbers))
    assert after["lost_samples"] == before["lost_samples"]
    check_frames(bench.simulation.frames)


def test_a_sensor_of_a_chain_is_named_by_position_serial_number_or_name() -> None:
    rows = (("BFT-SENS-ECAT-M8", 11), ("BFT-ROKS-ECAT-M8", 22), ("BFT-ROKS-ECAT-M8", 33))
    asking = Bench(*(SensorOptions(model=m, serial=n, signal="rest") for m, n in rows)).asking
    for choice, position in ((1, 1), ("2", 2), ("serial:22", 1), ("BFT-SENS-ECAT-M8", 0)):
        assert asking.ask("tare", sensor=choice, samples=1, target=[float(position)] * 6)["ok"]
        value = asking.ask("sdo_read", sensor=position, index=0x1018, subindex=4, type="u32")["value"]
        assert asking.ask("sdo_read", sensor=choice, index=0x1018, subindex=4, type="u32")["value"] == value
        assert asking.ask("configure", sensor=choice, settings={"imu_active": 3})["sensor"] == position
    for choice in ("BFT-ROKS-ECAT-M8", "serial:44", 3, "BFT-MEGS-ECAT-M8"):
        refused = error(asking.ask("sdo_read", sensor=choice, index=RATE))
        assert refused["code"] == "bad_request"
        assert "2: BFT-ROKS-ECAT-M8 with serial 33" in refused["message"], "it lists those there are"
    for wrong in (-1, 256, "", None, 1.5, "serial:x", ["0"]):
        assert error(asking.ask("sdo_read", sensor=wrong, index=RATE))["code"] == "bad_request"
