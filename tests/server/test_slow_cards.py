"""Slow network cards, and many sensors with clocks of their own, in simulated time: nothing is lost by it."""

from __future__ import annotations

import logging
import random
from collections.abc import Sequence

import pytest

from bota_ethercat.framing import DataMessage
from ethercat_server.acquisition import health
from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation, check_frames, fresh, more_if_long, reading

SETTLED_S = 3.0


def card(milliseconds: float, jitter_us: float = 0.0) -> Machine:
    """Round trips of this time, with up to so much more on either way."""
    return Machine(frame_ns=milliseconds * 1e6, frame_jitter_ns=5e3, even_jitter_ns=jitter_us * 1e3)


def run(machine: Machine, sinc_length: int, seconds: float = 3.0, ppm: float = -300.0) -> Simulation:
    """Runs a sensor; `frames` has what came after it has settled."""
    sensor = SensorOptions(signal="clock", ppm=ppm, sinc_length=sinc_length)
    running = Simulation(sensor, machine=machine, settings={"sinc_length": sinc_length})
    running.run(SETTLED_S)
    running.frames.clear()
    running.published_ns.clear()
    running.run(seconds)
    return running


def lost(frames: Sequence[DataMessage]) -> int:
    """Samples that are missing between the first and the last."""
    numbers = [reading(frame).number for frame in fresh(frames)]
    assert numbers == sorted(set(numbers)), "none twice, none out of order"
    return numbers[-1] - numbers[0] + 1 - len(numbers)


def of_each(running: Simulation) -> dict[int, list[DataMessage]]:
    """The frames by sensor."""
    by_sensor: dict[int, list[DataMessage]] = {}
    for frame in running.frames:
        by_sensor.setdefault(frame.sensor, []).append(frame)
    return by_sensor


CARDS = [
    (64, 0.86, 0), (64, 2.0, 0), (64, 3.0, 0), (64, 2.8, 400),
    (32, 0.44, 0), (32, 0.86, 0), (32, 2.0, 0), (32, 1.8, 400),
]  # fmt: skip
"""SINC length (64: 800 Hz), round trip in ms, jitter in µs."""


@pytest.mark.parametrize(("sinc_length", "milliseconds", "jitter_us"), CARDS)
def test_a_slow_card_costs_age_and_no_sample(
    sinc_length: int, milliseconds: float, jitter_us: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger=health.__name__)
    running = run(card(milliseconds, jitter_us), sinc_length)
    assert running.events == []
    check_frames(running.frames)
    assert lost(running.frames) <= 0.001 * len(running.frames)
    status = running.status()
    clock = status["sensors"][0]["clock"]
    assert clock["mode"] == "locked"
    assert clock["uncertainty_us"] < 1000 * milliseconds
    errors_us = [abs(f.monotonic_ns - reading(f).instant_ns) / 1000 for f in running.frames]
    within = sum(error <= clock["uncertainty_us"] for error in errors_us)
    assert within > 0.99 * len(errors_us)
    ages_us = sorted(
        (at_ns - reading(frame).instant_ns) / 1000
        for frame, at_ns in zip(running.frames, running.published_ns, strict=True)
    )
    best_us = 1000 * milliseconds / 2
    assert ages_us[len(ages_us) // 2] <= best_us + 1000 * milliseconds / 2 + 10
    (message,) = [each for each in caplog.messages if each.startswith("frames take ")]
    assert "older than through a PCIe network card" in message
    assert status["round_trip"]["usual_us"] == pytest.approx(1000 * milliseconds + jitter_us / 2, rel=0.1)


@pytest.mark.parametrize("milliseconds", [0.05, 2.0])
def test_register_reads_cost_a_slow_card_no_sample(milliseconds: float) -> None:
    running = run(card(milliseconds), 64)
    client = running.connect()
    running.frames.clear()
    for _ in range(40):
        assert client.ask("sdo_read", name="Sampling rate")["value"] == 800
    assert len(running.frames) > 100
    assert lost(running.frames) == 0


def test_an_answer_that_was_overtaken_is_no_news() -> None:
    running = run(Machine(frame_ns=1e6, late=0.05, late_ns=4e6), 64)
    check_frames(running.frames)


@pytest.mark.parametrize("seed", more_if_long([1], range(20)))
@pytest.mark.parametrize("disturbance_ms", [20, 300, 700])
def test_the_clock_holds_over_a_stop_of_the_machine(disturbance_ms: float, seed: int) -> None:
    machine = Machine(seed=seed, wake_ns=30_000, frame_jitter_ns=40_000)
    running = run(machine, 32, seconds=0.5)
    for _ in range(3):
        running.clock.stall(disturbance_ms * 1e6)
        running.run(0.02)
        assert running.streams[0].clock.locked
        running.frames.clear()
        running.run(0.6)
        check_frames(running.frames)
        assert lost(running.frames) <= 0.01 * len(running.frames)


@pytest.mark.parametrize("count", more_if_long([8], [8, 16]))
def test_many_sensors_with_clocks_of_their_own(count: int) -> None:
    chance = random.Random(count)
    sensors = [
        SensorOptions(serial=n + 1, signal="clock", ppm=chance.uniform(-300, 300)) for n in range(count)
    ]
    running = Simulation(*sensors)
    running.run(1.5)
    running.frames.clear()
    running.published_ns.clear()
    before = running.status()["cycles"]
    running.run(1.0)
    by_sensor = of_each(running)
    assert len(by_sensor) == count
    for frames in by_sensor.values():
        check_frames(frames)
    assert sum(map(lost, by_sensor.values())) <= 0.001 * len(running.frames)
    ages_ns = sorted(
        at_ns - reading(frame).instant_ns
        for frame, at_ns in zip(running.frames, running.published_ns, strict=True)
    )
    assert ages_ns[int(0.99 * len(ages_ns))] < 1_250_000
    assert running.status()["cycles"] - before < 800 * count * 1.15


@pytest.mark.parametrize("sinc_length", more_if_long([256], [64, 256]))
def test_process_data_in_two_frames_is_as_complete(sinc_length: int) -> None:
    sensors = [
        SensorOptions(serial=n + 1, signal="clock", pdo_size=77, ppm=10.0 * n, sinc_length=sinc_length)
        for n in range(20)
    ]
    running = Simulation(*sensors, settings={"sinc_length": sinc_length})
    running.run(0.4)
    running.frames.clear()
    running.run(0.2)
    by_sensor = of_each(running)
    assert sorted(by_sensor) == list(range(20))
    for frames in by_sensor.values():
        check_frames(frames)
        assert lost(frames) <= 1
    running.command("power off @19")
    running.run_until(lambda: running.events, "it is missed")
    assert [(event["event"], event["sensor"]) for event in running.events] == [("sensor_lost", 19)]
