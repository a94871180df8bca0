"""What clients ask and get, in simulated time: subscriptions, process data, events, the end of the server."""

from __future__ import annotations

from itertools import pairwise

import pytest

from bota_ethercat.pdo import LAYOUTS
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.server.bench import error
from tests.simulation import Client, Simulation, check_frames

CLOCK = SensorOptions(signal="clock", ppm=150.0)
STRANGER = 4711
"""A user who may not control."""


def subscribed(simulation: Simulation, **keys: object) -> Client:
    client = simulation.connect()
    assert client.ask("subscribe", **keys)["ok"]
    return client


@pytest.mark.parametrize("size", [61, 77])
def test_process_data_is_byte_for_byte_what_the_sensor_sent(size: int) -> None:
    simulation = Simulation(SensorOptions(pdo_size=size, signal="ramp", noise=False))
    client = subscribed(simulation)
    assert client.ask("describe")["sensors"][0]["pdo_size"] == size
    frames = client.fresh(300)
    assert {len(frame.process_data) for frame in frames} == {size}
    layout = LAYOUTS[size]
    for frame in frames:
        # Unpacked and packed again it is the same: nothing is shifted, swapped or padded.
        assert layout.struct.pack(*layout.struct.unpack(frame.process_data)) == frame.process_data
    life = simulation.backend.sensors.sensors[0].life
    assert life is not None
    stream = simulation.streams[0]
    simulation.run_until(lambda: stream.process_data == life.inputs(), "what the sensor has now")


def test_several_clients_get_the_same_frames() -> None:
    simulation = Simulation(CLOCK)
    clients = [subscribed(simulation) for _ in range(5)]
    simulation.run(1.0)
    first = {frame.sequence: frame for frame in clients[0].frames}
    for client in clients[1:]:
        check_frames(client.frames)
        assert len(client.frames) > 700
        assert all(first[frame.sequence] == frame for frame in client.frames)


def test_unsubscribe_stops_the_frames() -> None:
    simulation = Simulation(CLOCK)
    client = subscribed(simulation)
    client.collect(5)
    assert client.ask("unsubscribe")["ok"]
    client.frames.clear()
    simulation.run(1.0)
    assert not client.frames


def test_a_subscription_to_one_sensor_in_n_frames() -> None:
    simulation = Simulation(CLOCK, SensorOptions(signal="clock", serial=2))
    client = subscribed(simulation, sensors=[1], every=4)
    frames = client.collect(100)
    assert {frame.sensor for frame in frames} == {1}
    steps = [after.sequence - before.sequence for before, after in pairwise(frames)]
    assert set(steps) == {4}


def test_others_may_read_and_not_control() -> None:
    simulation = Simulation(CLOCK)
    client = simulation.connect(STRANGER)
    for action, keys in (
        ("configure", {"settings": {"fir": True}}),
        ("tare", {}),
        ("sdo_write", {"index": 0x8000, "subindex": 1, "hex": "00000000"}),
        ("sii_read", {"word": 0}),
        ("shutdown", {}),
    ):
        assert error(client.ask(action, **keys))["code"] == "denied", action
    for action, keys in (
        ("describe", {}),
        ("status", {}),
        ("subscribe", {}),
        ("sdo_read", {"index": 0x1008}),
    ):
        assert client.ask(action, **keys)["ok"], action
    assert len(client.fresh(50)) == 50


def test_shutdown_ends_the_loop_and_takes_the_sensor_to_init() -> None:
    simulation = Simulation(CLOCK)
    watcher, asking = subscribed(simulation), simulation.connect()
    assert asking.ask("shutdown")["ok"]
    assert simulation.cycle.stopping
    simulation.close()
    assert simulation.stats()["al_state"] == "INIT"
    watcher.receive()
    assert watcher.at_end
    again = Simulation(backend=simulation.backend)
    assert len(subscribed(again).fresh(50)) == 50
