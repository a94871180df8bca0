"""A machine that wakes late over answers: the kernel says when they had arrived, and stamps are right."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median

import pytest

from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Simulation, fresh, reading

WAKES_NS = 120_000
SETTLED_S = 3.0


def errors_ns(monkeypatch: pytest.MonkeyPatch, dc: str, arrived_ns: Callable[[], int] | None) -> list[int]:
    """Of the stamps of a second, by a kernel that says `arrived_ns` of each answer (None: the truth)."""
    running = Simulation(SensorOptions(signal="clock", ppm=150.0, dc=dc))
    backend = running.backend
    receive = backend.receive

    def late(timeout_s: float) -> bytes | None:
        frame = receive(timeout_s)
        if frame is not None:
            backend.clock.advance(backend.clock.now_ns + WAKES_NS)
        return frame

    monkeypatch.setattr(backend, "receive", late)
    if arrived_ns is not None:
        monkeypatch.setattr(backend, "arrived_ns", arrived_ns)
    running.run(SETTLED_S)
    count = len(running.frames)
    running.run(1.0)
    status = running.status()["sensors"][0]
    assert status["lost_samples"] == status["invalid"] == 0
    assert status["clock"]["stamps"] == ("polling" if dc == "none" else "hardware")
    return [frame.monotonic_ns - reading(frame).instant_ns for frame in fresh(running.frames[count:])]


@pytest.mark.parametrize("dc", ["", "none"])
def test_stamps_do_not_depend_on_how_late_the_machine_wakes(monkeypatch: pytest.MonkeyPatch, dc: str) -> None:
    assert abs(median(errors_ns(monkeypatch, dc, None))) < WAKES_NS / 8


@pytest.mark.parametrize("wrong", [0, -5, 1 << 80])
def test_an_arrival_that_cannot_be_is_not_used(monkeypatch: pytest.MonkeyPatch, wrong: int) -> None:
    error_ns = median(errors_ns(monkeypatch, "", lambda: wrong))
    assert WAKES_NS / 3 < error_ns < WAKES_NS * 2 / 3, "half of the wake-up counts as the way out"


@pytest.mark.parametrize("count", [1, 3])
def test_neither_the_length_of_a_frame_nor_the_slaves_behind_are_in_a_stamp(count: int) -> None:
    running = Simulation(*(SensorOptions(serial=n + 1, signal="clock", ppm=150.0) for n in range(count)))
    running.run(SETTLED_S)
    running.frames.clear()
    running.run(1.0)
    for number in range(count):
        frames = [frame for frame in fresh(running.frames) if frame.sensor == number]
        assert abs(median(frame.monotonic_ns - reading(frame).instant_ns for frame in frames)) < 500
