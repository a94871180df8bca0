"""Nothing of what clients ask for, and of what goes wrong, is left to a garbage collector: the loop has none.

Every test checks as much for exceptions that keep themselves alive (tests/exception_cycles.py).
"""

from __future__ import annotations

import gc
import random
import weakref
from collections.abc import Iterator
from functools import partial

import pytest

from bota_ethercat.control import ACTIONS, Parameter
from bota_ethercat.text.json_text import JsonObject
from ethercat_server.daemon.loss_traces import LossTraces
from ethercat_server.daemon.server import SystemdNotifier, every_second
from ethercat_server.serving.connection import Connection
from ethercat_server.virtual_sensor.options import SensorOptions
from tests.simulation import Client, Simulation, more_if_long

CLIENTS, PERIODS = 12, 12
# For any key of a request, whether it fits or not.
VALUES: tuple[object, ...] = (
    0, 1, 2, 7, 300, -1, True, None, "", "name", "serial:1", 0x1008, 0x2000, 0x8010, "0x8011", "f32", "00",
    [0], [0.0] * 6, [1e9] * 6, {"sinc_length": 128}, {"sinc_length": 64}, {"imu_active": 0}, {"chop": True},
    {"imu_active": 1, "acceleration_filter": 2}, {"no_such": 1}, {},
)  # fmt: skip
FAULTS = (
    "power cycle 0.3", "deaf 0.08", "lose 20", "safeop 0x001B", "error 0x001A", "mute-mailbox 3",
    "abort 0x8010 1 0x06090030", "abort 0x8000 1 0x08000021", "abort 0x8006 1 0x06010002", "emergency 0xFF01",
    "on-write 0x8006 1 power cycle 0.2", "on-write 0x8000 2 deaf 0.3", "sii error", "sii ok", "saving 0.2 3",
    "stick", "unstick", "swap BFT-SENS-ECAT-M8 99", "disconnect", "connect", "signal rest",
)  # fmt: skip


@pytest.fixture(autouse=True)
def without_collector() -> Iterator[None]:
    """As in the loop."""
    gc.disable()
    yield
    gc.enable()


def any_request(chance: random.Random, action: str) -> dict[str, object]:
    """A request whose keys are chosen at random, more often than not such as make sense."""

    def value(key: str, parameter: Parameter) -> object:
        if key == "settings" and chance.random() < 0.8:
            return chance.choice(
                ({"sinc_length": 128}, {"sinc_length": 64}, {"imu_active": chance.randrange(3)})
            )
        if key == "samples" and chance.random() < 0.8:
            return 20
        if key == "sensor" and chance.random() < 0.8:
            return chance.randrange(2)
        return chance.choice(VALUES)

    keys = ACTIONS[action].parameters.items()
    return {
        key: value(key, parameter) for key, parameter in keys if parameter.required or chance.random() < 0.6
    }


@pytest.mark.parametrize("seed", more_if_long(range(2), range(40)))
def test_requests_refusals_losses_and_recoveries_leave_nothing_to_collect(
    seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    chance = random.Random(seed)
    simulation = Simulation(SensorOptions(signal="rest"), SensorOptions(signal="rest"))
    clients = [simulation.connect(0 if number % 3 else 4711) for number in range(CLIENTS)]
    # Kept, because they are made of cycles: the ends of a connection, what a virtual sensor loses with power.
    gone, lives = list[Client](), set[object]()
    simulation.on_serve = lambda _: lives.update(slave.life for slave in simulation.backend.sensors.slaves)
    for _ in range(PERIODS):
        clients.append(simulation.connect(chance.choice((0, 4711))))
        for client in clients:
            for _ in range(chance.randrange(3)):
                # The others are more likely to be under way when something happens.
                action = chance.choice(
                    [*ACTIONS, "configure", "configure", "configure", "sdo_read", "tare", "no_such"]
                )
                if action != "shutdown":
                    keys = any_request(chance, action) if action in ACTIONS else {}
                    client.send(action, **keys)
        fault = chance.choice(FAULTS) + chance.choice((" @0", " @1"))
        if chance.random() < 0.5:
            simulation.at(chance.uniform(0, 0.2), partial(simulation.backend.command, fault))
        simulation.run(chance.uniform(0.05, 0.4))
        gone.append(clients.pop(chance.randrange(len(clients))))
        gone[-1].close()
    simulation.run(5.0)  # a request to a sensor that is lost, of a client that has left, takes so long
    replies = [reply for client in clients + gone for reply in client.replies]
    codes = {reply.get("error", {}).get("code", "ok") for reply in replies}
    # Whether a request meets one under way goes by the seed.
    assert codes >= {"ok", "bad_request", "denied"} | ({"busy"} if seed < 3 else set())
    assert len(simulation.hub.connections) == len(clients)
    assert "Traceback" not in caplog.text
    assert gc.collect() == 0


class DefectError(Exception):
    """It keeps itself alive."""


def test_what_a_defect_leaves_in_cycles_is_freed_within_a_second() -> None:
    simulation, left = Simulation(settings={"sinc_length": 512}), list[weakref.ref[DefectError]]()

    def defective(_connection: Connection, _message: JsonObject) -> JsonObject:
        try:
            raise DefectError
        except DefectError as error:
            kept = error
        left.append(weakref.ref(kept))
        return {}

    simulation.hub.start(defective)
    traces = LossTraces(simulation.server)
    simulation.cycle.every_second = partial(every_second, simulation.server, SystemdNotifier(), traces)
    client = simulation.connect()
    for _ in range(5):
        for _ in range(10):
            client.send("status")
        simulation.run(1.0)
    simulation.run(0.001)  # each run begins with it
    assert len(left) == 50
    assert [each() for each in left] == [None] * 50
