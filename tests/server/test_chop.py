"""CHOP may divide the sampling rate, which object 0x8011 then says: everything follows the true rate."""

from __future__ import annotations

import logging

import pytest

from bota_ethercat.settings import rate_divisor, sampling_rate_hz
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.bench import Bench, error
from tests.simulation import Simulation, check_frames, fresh, reading

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
    frames = fresh(simulation.frames)
    numbers = [reading(frame).number for frame in frames[1:]]
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
        changed = bench.asking.ask("configure", settings={"chop": chop})
        assert (changed["ok"], changed["rate_hz"]) == (True, rate_hz)
        told = bench.wait_event("reconfigured")
        assert (told["settings"]["chop"], told["rate_hz"]) == (chop, rate_hz)
        assert bench.asking.ask("describe")["sensors"][0]["rate_hz"] == rate_hz
        if chop:
            check_halved(bench.simulation)


def test_a_rate_that_chop_does_not_explain_is_refused() -> None:
    bench = Bench(SensorOptions(signal="clock", chop_divides=9))
    refused = error(bench.asking.ask("configure", settings={"chop": True}))
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


def test_what_divides_a_rate() -> None:
    for length in (32, 51, 64, 205, 341, 1000):
        rate_hz = sampling_rate_hz(length)
        for chop in (False, True):
            assert rate_divisor(length, rate_hz, chop) == 1
        for by in range(2, 9):
            assert rate_divisor(length, round(rate_hz / by), True) == by
            assert rate_divisor(length, round(rate_hz / by), False) is None
    for length, rate_hz in ((64, 0), (0, 800), (-1, 800), (64, 1600), (64, 300), (64, 89)):
        assert rate_divisor(length, rate_hz, True) is None
