"""Changes that fail or are cut off leave the former settings in force, and say so. In simulated time."""

from __future__ import annotations

from typing import Any

import pytest

from tests.server.bench import Bench, error
from tests.simulation import Client, more_if_long

CONFIGURATION, OFFSET, RATE = 0x8010, 0x8000, 0x8011
IN_OP = {"temperature_compensation": True, "imu_active": 3}
BY_PREOP = {"chop": True, "sinc_length": 128}
ABORT = "0x08000021"


def moments(step_ms: int, count: int) -> list[Any]:
    """In ms; every third one, and all of them with --long."""
    every = range(0, count * step_ms, step_ms)
    return more_if_long(every[::3], every)


@pytest.fixture
def bench() -> tuple[Bench, Client]:
    """A stationary sensor, and two clients: one that listens, one that asks."""
    found = Bench()
    return found, found.asking


def row(asking: Client) -> dict[str, Any]:
    found: dict[str, Any] = asking.ask("describe")["sensors"][0]
    return found


def held(asking: Client, index: int, subindex: int) -> int:
    """What the sensor itself holds, in one byte."""
    return int(asking.ask("sdo_read", index=index, subindex=subindex)["hex"], 16)


def check_former(bench: Bench, asking: Client, before: dict[str, Any]) -> None:
    """The server says that the former settings are in force, the sensor holds them, and samples come."""
    assert len(bench.client.fresh(50)) == 50
    now = row(asking)
    assert (now["settings"], now["rate_hz"], now["state"]) == (before["settings"], before["rate_hz"], "OP")
    assert held(asking, CONFIGURATION, 2) == 0
    assert held(asking, CONFIGURATION, 3) == 1
    assert held(asking, 0x8006, 4) == 0
    assert asking.ask("sdo_read", index=RATE, type="u16")["value"] == 800


@pytest.mark.parametrize(
    ("settings", "what", "said"),
    [
        (IN_OP, "0x8010 3", "imu_active = 3 did not take"),
        (BY_PREOP, "0x8006 1", "sinc_length = 128 did not take"),
    ],
)
def test_an_abort_half_way(
    bench: tuple[Bench, Client], settings: dict[str, Any], what: str, said: str
) -> None:
    sensor, asking = bench
    before = row(asking)
    sensor.command(f"abort {what} {ABORT}")
    refused = error(asking.ask("configure", settings=settings))
    assert (refused["code"], refused["abort_code"]) == ("sensor", int(ABORT, 16))
    assert said in refused["message"]
    assert refused["message"].endswith("; the former settings are in force")
    check_former(sensor, asking, before)
    assert not [event for event in sensor.client.events if event["event"] != "reconfigured"]


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
    bench: tuple[Bench, Client], settings: dict[str, Any], when: str, fault: str
) -> None:
    sensor, asking = bench
    before = row(asking)
    sensor.command(f"on-write {when} {fault}")
    refused = error(asking.ask("configure", settings=settings))
    assert refused["code"] == "not_ready"
    assert refused["message"].endswith("; it gets its former settings when it is back")
    sensor.wait_event("sensor_lost")
    back = sensor.wait_event("sensor_back")
    assert back["settings"] == before["settings"]
    check_former(sensor, asking, before)
    assert asking.ask("configure", settings=settings)["ok"], "the next one takes"


def test_whoever_asked_is_told_at_once_that_the_sensor_is_lost(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    before = row(asking)
    sensor.command("on-write 0x8006 4 power off")
    assert error(asking.ask("configure", settings=BY_PREOP))["code"] == "not_ready"
    assert row(asking)["state"] == "LOST"
    assert error(asking.ask("configure", settings=BY_PREOP))["code"] == "not_ready"
    sensor.command("power on")
    sensor.wait_event("sensor_back")
    check_former(sensor, asking, before)


@pytest.mark.parametrize("comes_back", [False, True])
def test_putting_back_the_former_settings_fails_too_in_op(
    bench: tuple[Bench, Client], comes_back: bool
) -> None:
    """It is put back when the sensor comes back."""
    sensor, asking = bench
    before = row(asking)
    sensor.command(f"abort 0x8010 3 {ABORT}")
    sensor.command("on-write 0x8010 3 abort 0x8010 2 0x08000022")
    refused = error(asking.ask("configure", settings=IN_OP))
    assert "imu_active = 3 did not take" in refused["message"]
    assert (
        "; restoring the former settings failed too: the setting temperature_compensation"
        in refused["message"]
    )
    assert refused["message"].endswith("; configure it again")
    assert held(asking, CONFIGURATION, 2) == 1, "so it is"
    if comes_back:
        sensor.command("deaf 0.3")
        sensor.wait_event("sensor_back")
        check_former(sensor, asking, before)
    again = asking.ask("configure", settings={"temperature_compensation": True, "imu_active": 2})
    assert again["ok"], again
    assert (held(asking, CONFIGURATION, 2), held(asking, CONFIGURATION, 3)) == (1, 2)


def test_putting_back_the_former_settings_fails_too_by_way_of_preop(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    before = row(asking)
    sensor.command(f"abort 0x8006 1 {ABORT}")
    sensor.command("on-write 0x8006 1 abort 0x8006 1 0x08000022")
    refused = error(asking.ask("configure", settings=BY_PREOP))
    assert "sinc_length = 128 did not take" in refused["message"]
    assert "; restoring the former settings failed too: " in refused["message"]
    assert refused["message"].endswith("; it gets its former settings when it is back")
    sensor.wait_event("sensor_lost")
    sensor.wait_event("sensor_back")
    check_former(sensor, asking, before)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("power cycle 0.3", "; it gets its old offset when it is back"),
        ("deaf 0.4", "; it gets its old offset when it is back"),
        (f"abort 0x8000 5 {ABORT}", "; the old offset is in force"),
    ],
)
def test_a_tare_cut_off_half_way_leaves_the_old_offset(
    bench: tuple[Bench, Client], fault: str, said: str
) -> None:
    sensor, asking = bench
    first = asking.ask("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    assert first["ok"], first
    sensor.client.events.clear()
    sensor.command(f"on-write 0x8000 3 {fault}")
    refused = error(asking.ask("tare", samples=20, target=[0, 0, 0, 1, 1, 1]))
    assert refused["message"].endswith(said), refused
    if "back" in said:
        sensor.wait_event("sensor_back")
    offset = [asking.ask("sdo_read", index=OFFSET, subindex=n, type="f32")["value"] for n in range(1, 7)]
    assert offset == pytest.approx(first["new_offset"])
    again = asking.ask("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    assert again["ok"], again
    assert again["old_offset"] == pytest.approx(first["new_offset"])


def test_a_save_that_ends_with_a_status_is_no_success(bench: tuple[Bench, Client]) -> None:
    sensor, asking = bench
    sensor.command(f"abort 0x8030 1 {ABORT}")
    refused = error(asking.ask("configure", settings={"imu_active": 3}, save=True))
    assert refused["message"].endswith("; its settings are in force until its power goes, but not saved")
    assert row(asking)["settings"]["imu_active"] == 3
    sensor.client.fresh(400)
    sensor.command("saving 0 7")
    refused = error(asking.ask("configure", settings={"imu_active": 1}, save=True))
    assert "did not save its settings (status 7): they are in force until" in refused["message"]
    sensor.command("saving 0.3")
    saved = asking.ask("configure", settings={"imu_active": 3}, save=True)
    assert saved["ok"], saved
    assert saved["saved"] is True


def test_a_power_cut_during_save_is_met_by_the_next_start(caplog: pytest.LogCaptureFixture) -> None:
    """The flash has 0x8000 to 0x8006:3 new, the rest old: a mixture that nobody asked for."""
    caplog.set_level("INFO")
    bench = Bench()
    cut_while_saving(bench)
    bench.command("power on")
    caplog.clear()
    bench = bench.start_again()
    said = caplog.text
    assert "sensor 0 held fir = true (wanted: false)" in said, said
    assert "a sampling rate of 400 Hz (wanted: 800 Hz)" in said
    assert "chop" not in said, "its turn had not come"
    assert "sensor 0 has a tare in force (saved or not): Fx offset 3.5 N" in said
    found = row(bench.asking)
    assert (found["state"], found["rate_hz"]) == ("OP", 800)
    assert (found["settings"]["fir"], found["settings"]["chop"]) == (False, False)
    assert found["settings"]["sinc_length"] == 64
    assert len(bench.client.fresh(50)) == 50
    caplog.clear()
    bench.start_again()
    assert " held " not in caplog.text, "now it holds what is wanted"


def cut_while_saving(bench: Bench) -> None:
    """FIR, SINC 128, CHOP and an offset are in force; the power goes after FIR was saved, before CHOP."""
    tared = bench.asking.ask("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    assert tared["ok"], tared
    assert tared["new_offset"][0] == 3.5
    assert bench.asking.ask("configure", settings={"fir": True, "sinc_length": 128, "chop": True})["ok"]
    bench.command("cut-save 27")
    refused = error(bench.asking.ask("configure", settings={"fir": True}, save=True))
    assert refused["code"] == "not_ready"
    assert "whether it saved all, some or none of its settings is not known" in refused["message"]


@pytest.mark.parametrize("after", moments(2, 30))
def test_a_sensor_lost_at_any_moment_of_a_change_has_its_former_settings_or_the_new_ones(after: int) -> None:
    """The power goes `after` ms into the change; what the reply says is what is in force."""
    bench = Bench()
    asking = bench.asking
    before = row(asking)["settings"]
    number = asking.send("configure", settings=BY_PREOP)
    bench.simulation.at(after * 1e-3, "power cycle 0.2")
    reply = asking.reply(number)
    bench.simulation.run(0.5)
    asking.ask("status")
    found = row(asking)
    assert found["state"] == "OP"
    assert found["settings"] == (reply["settings"] if reply["ok"] else before)
    assert held(asking, 0x8006, 4) == found["settings"]["chop"]
    assert len(bench.client.fresh(50)) == 50
    assert asking.ask("configure", settings=BY_PREOP)["ok"], "the next one takes"


@pytest.mark.parametrize("after", moments(3, 30))
def test_a_sensor_lost_at_any_moment_of_a_tare_has_its_old_offset_or_the_new_one(after: int) -> None:
    """It is deaf `after` ms into the tare; what the reply says is what is in force."""
    bench = Bench()
    asking = bench.asking
    number = asking.send("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    bench.simulation.at(after * 1e-3, "power cycle 0.2")
    reply = asking.reply(number)
    bench.simulation.run(0.5)
    offset = [asking.ask("sdo_read", index=OFFSET, subindex=n, type="f32")["value"] for n in range(1, 7)]
    assert offset == pytest.approx(reply["new_offset"] if reply["ok"] else [0.0] * 6)
