"""However slow the machine: a sensor that answers at all streams, comes back, and keeps its settings."""

from __future__ import annotations

import pytest

from ethercat_server.simulation.machine import Machine
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Client, Simulation, check_frames, fresh, more_if_long

FRAME_MS = (1, 3, 5, 10, 20, 30)
MACHINES = {
    **{f"frames take {ms} ms": Machine(frame_ns=ms * 1e6, frame_jitter_ns=1e6) for ms in FRAME_MS},
    **{f"{ms} ms, often more": Machine(frame_ns=ms * 1e6, frame_jitter_ns=10e6) for ms in FRAME_MS},
    **{
        f"{ms} ms, with stalls": Machine(
            frame_ns=ms * 1e6, frame_jitter_ns=3e6, wake_ns=10e6, stall_every_s=0.3, stall_ns=200e6
        )
        for ms in FRAME_MS
    },
    "frames get lost too": Machine(
        frame_ns=5e6, frame_jitter_ns=5e6, wake_ns=10e6, stall_every_s=0.5, stall_ns=200e6, lost=0.02
    ),
}


def streaming() -> tuple[Simulation, Client]:
    simulation = Simulation(SensorOptions(signal="clock"), settings={"acceleration_range_g": 8})
    client = simulation.connect()
    client.ask("subscribe")
    simulation.run(0.5)
    return simulation, client


USUAL = (
    "frames take 1 ms", "frames take 10 ms", "frames take 30 ms", "3 ms, often more", "5 ms, with stalls",
    "30 ms, with stalls", "frames get lost too",
)  # fmt: skip


@pytest.mark.parametrize("machine", more_if_long(USUAL, MACHINES))
def test_samples_come_and_come_back_after_a_power_cut(machine: str) -> None:
    simulation, client = streaming()
    simulation.backend.become(MACHINES[machine])
    for _ in range(2):
        simulation.run_until(lambda: not client.events and client.fresh(20), "samples", 20)
        simulation.command("power cycle 0.3")
        client.events.clear()
        client.wait_event("sensor_lost")
        back = client.wait_event("sensor_back")
        assert back["settings"]["acceleration_range_g"] == 8
        client.fresh(20)
        client.events.clear()
    assert client.ask("status")["ok"]
    check_frames(simulation.frames)
    simulation.backend.become(Machine())
    simulation.run(1.0)
    simulation.frames.clear()
    simulation.run(0.5)
    assert len(fresh(simulation.frames)) > 390, "as fast as the machine again"


@pytest.mark.parametrize("milliseconds", more_if_long([1, 5, 30], FRAME_MS))
def test_a_sensor_is_not_lost_because_its_frames_take_long(milliseconds: int) -> None:
    simulation, client = streaming()
    simulation.backend.become(Machine(frame_ns=milliseconds * 1e6, frame_jitter_ns=0.2e6))
    simulation.run(2.0)
    client.events.clear()
    before = simulation.status()["lost_frames"]
    simulation.run(4.0)
    assert client.events == []
    assert simulation.status()["lost_frames"] - before <= 8
    assert len(client.fresh(50)) == 50


def test_a_single_late_answer_makes_the_loop_wait_longer_for_some_exchanges_only() -> None:
    simulation, client = streaming()
    simulation.run(0.5)
    simulation.backend.become(Machine(frame_ns=5e6))
    client.frames.clear()
    simulation.run(0.02)
    simulation.backend.become(Machine())
    simulation.run(0.1)
    before = simulation.status()["sensors"][0]["lost_samples"]
    for _ in range(10):
        simulation.command("lose 1")
        client.fresh(20)
    assert simulation.status()["sensors"][0]["lost_samples"] - before <= 1


def test_settings_are_changed_on_a_slow_machine() -> None:
    simulation = Simulation(SensorOptions(signal="rest"))
    client = simulation.connect()
    client.ask("subscribe")
    simulation.backend.become(Machine(frame_ns=10e6, frame_jitter_ns=1e6, wake_ns=5e6))
    simulation.run(3.0)
    changed = client.ask("configure", settings={"chop": True})
    assert changed["ok"], changed
    assert client.ask("sdo_read", name="Sampling rate")["value"] == 800
