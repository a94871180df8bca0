"""What the samples show of a sensor: silence, in the log."""

from __future__ import annotations

import pytest

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
    simulation = Simulation()
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
    simulation = Simulation()
    simulation.run(2.0)
    simulation.command("power cycle 5")
    simulation.run(10.0)
    assert said(log, "is back after")
    assert not said(log, "gives n")
