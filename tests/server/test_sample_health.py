"""What the samples show of a sensor: silence and numbers that are not finite, in the log and in `status`."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from bota_ethercat.pdo import LAYOUTS, encode
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level("INFO")
    return caplog


def said(log: pytest.LogCaptureFixture, words: str) -> list[str]:
    return [record.getMessage() for record in log.records if words in record.getMessage()]


def test_a_sensor_that_gives_nothing_new_is_logged_once_and_again_when_it_does(
    log: pytest.LogCaptureFixture,
) -> None:
    simulation = Simulation(settings={"sinc_length": 512})
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
    simulation = Simulation(settings={"sinc_length": 512})
    simulation.run(2.0)
    simulation.command("power cycle 5")
    simulation.run(10.0)
    assert said(log, "is back after")
    assert not said(log, "gives n")


def measure(simulation: Simulation, **values: float) -> None:
    """Have sensor 0 measure these values from now on, each sample a new one; as it did before without any."""
    sampler: Any = simulation.backend.sensors.sensors[0].life.sampler  # type: ignore[union-attr]
    vars(sampler).pop("newest", None)
    if values:
        newest, count = sampler.newest, itertools.count()
        last: list[bytes] = [b"", b""]

        def changed(later: int = 0) -> bytes:
            if last[0] != newest(later):
                last[:] = newest(later), encode(len(newest(later)), {**values, "torque.z": next(count)})
            return last[1]

        sampler.newest = changed


@pytest.mark.parametrize("field", ["force.x", "acceleration.z", "temperature", "orientation.w"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
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


def test_what_is_discarded_after_a_start_is_not_counted() -> None:
    simulation = Simulation()
    measure(simulation, **{"force.x": math.nan})
    simulation.run_until(lambda: simulation.streams[0].process_data, "a sample")
    simulation.run_until(lambda: simulation.streams[0].fresh, "a frame")
    row = simulation.status()["sensors"][0]
    assert row["not_finite"] == row["fresh"] > 0


def test_not_finite_is_logged_when_it_begins_and_when_it_is_over(log: pytest.LogCaptureFixture) -> None:
    simulation = Simulation(settings={"sinc_length": 512})
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
