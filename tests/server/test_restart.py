"""A server that is started again, in simulated time. As processes: see test_end_to_end.py."""

from __future__ import annotations

import pytest

from ethercat_server.errors import BusError
from tests.server.bench import Bench
from tests.simulation import Asked


def test_the_next_one_finds_the_sensor_in_op_after_one_that_was_killed() -> None:
    killed = Bench()
    again = Bench(backend=killed.simulation.backend)
    assert len(again.client.fresh(100)) == 100
    assert again.asking.ask("describe")["sensors"][0]["state"] == "OP"


def test_a_tare_that_was_not_saved_outlives_the_server_and_then_a_power_cut(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    bench = Bench()
    tared = bench.asking.ask("tare", samples=20, target=[5.0, 0, 0, 0, 0, 0])
    assert tared["ok"], tared
    caplog.clear()
    bench = bench.start_again()
    assert "sensor 0 has a tare in force (saved or not): Fx offset" in caplog.text
    bench.command("power cycle 0.3")
    bench.wait_event("sensor_back")
    held = bench.asking.ask("sdo_read", index=0x8000, subindex=1, type="f32")["value"]
    assert held == pytest.approx(tared["new_offset"][0])


SAVED = {"sinc_length": 51, "fir": True}


@pytest.fixture
def saved() -> Bench:
    """A sensor whose settings somebody saved, and that was powered off since."""
    bench = Bench()
    assert bench.asking.ask("configure", settings=SAVED, save=True)["ok"]
    bench.simulation.close()
    bench.command("power off")
    bench.command("power on")
    return bench


def in_force(bench: Bench) -> tuple[int, bool, int]:
    row = bench.asking.ask("describe")["sensors"][0]
    return row["settings"]["sinc_length"], row["settings"]["fir"], row["rate_hz"]


def test_a_start_writes_the_defaults_over_what_was_saved_and_says_so(
    saved: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    assert in_force(Bench(backend=saved.simulation.backend)) == (64, False, 800)
    (line,) = [line for line in caplog.messages if " held " in line]
    assert "a sampling rate of 1003 Hz (wanted: 800 Hz)" in line
    assert "nobody set fir, sinc_length: --unset-settings keep leaves what the sensor has" in line


def test_what_somebody_set_is_not_said_to_be_unset(saved: Bench, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    Bench(backend=saved.simulation.backend, settings={"sinc_length": 64, "fir": False})
    assert " held " in caplog.text
    assert "nobody set" not in caplog.text


def test_what_nobody_set_is_kept_if_that_is_asked_for_and_outlives_a_power_cut(
    saved: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    bench = Bench(backend=saved.simulation.backend, wanted=Asked({"fir": False}, keep_unset=True))
    assert in_force(bench) == (51, False, 1003)
    assert "sensor 0 keeps what nobody set: sinc_length = 51" in caplog.text
    assert "nobody set fir" not in caplog.text
    assert bench.asking.ask("configure", settings={"imu_active": 0})["ok"]
    bench.command("power cycle 0.3")
    bench.wait_event("sensor_back")
    assert in_force(bench) == (51, False, 1003)
    assert len(bench.client.fresh(50)) == 50


def test_kept_settings_that_contradict_those_set_end_the_start(saved: Bench) -> None:
    backend = Bench(backend=saved.simulation.backend).start_again().simulation.backend
    with pytest.raises(BusError, match="contradict those set: fast is true but fir is false"):
        Bench(backend=backend, wanted=Asked({"fast": True}, keep_unset=True))


def test_a_fresh_sensor_has_nothing_to_keep_but_the_defaults(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    assert in_force(Bench(wanted=Asked(keep_unset=True))) == (64, False, 800)
    assert "sensor 0 keeps what nobody set: the defaults" in caplog.text
