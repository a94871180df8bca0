"""docs/examples/mujoco in simulated time: through the virtual sensor, the server and the client."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import math
import socket
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest

from bota_ethercat.client import Client, Condition, Reading
from bota_ethercat.world import Felt
from docs.examples.mujoco import identify
from docs.examples.mujoco.touch import FORCE, HOLE, TIP, Row, Touch, draw
from ethercat_server.simulation.server import MemoryChannel
from tests.simulation import PATIENCE_S, Simulation

WALL = 15_000.0  # N/m


class SpringArm:
    """A tip that moves as it is told, before a wall of springs with a hole."""

    rotation = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])

    def __init__(self) -> None:
        self.velocity, self.tip = np.zeros(3), np.array([HOLE[0] - 0.002, 0.0, HOLE[2] - 0.01])

    def step(self, _seconds: float) -> Felt:
        """A world."""
        self.tip = self.tip + 1e-3 * self.velocity
        in_hole = abs(self.tip[2] - HOLE[2]) < 0.001
        force = 0.0 if in_hole else -WALL * max(0.0, self.tip[0] - HOLE[0])
        return Felt((*(self.rotation.T @ (force, 0.0, 0.0)), 0.0, 0.0, 0.0))


def arm() -> Any:
    """The one in MuJoCo."""
    from docs.examples.mujoco.arm import Arm

    return Arm()


ROBOTS = [SpringArm, pytest.param(arm, marks=pytest.mark.long)]


def simulated(robot: Any) -> Simulation:
    """The server's sensor on this robot; a slow one on the springs, which is quicker to simulate."""
    return Simulation(world=robot.step, settings={"sinc_length": 128 if type(robot) is SpringArm else 64})


def perform(simulation: Simulation, task: Any, until: Callable[[Reading], object] = lambda _: False) -> None:
    """Have the task done in this simulation, or until something is so of a reading."""
    with Client(12001, channel=MemoryChannel(simulation)).connect() as sensor:
        while not task.done:
            passed_s = (simulation.clock.now_ns - simulation.started_ns) * 1e-9
            assert passed_s < PATIENCE_S
            reading = sensor.latest(timeout_s=0.005)
            task.update(reading, passed_s)
            if until(reading):
                return


def touched(rows: list[Row]) -> int:
    """The first row in which the wall was felt."""
    return next(number for number, row in enumerate(rows) if row.force > FORCE / 2)


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_presses_with_10_n_and_finds_the_hole(robot: Callable[[], Any], tmp_path: Path) -> None:
    made = robot()
    touch = Touch(made)
    perform(simulated(made), touch)
    first = touch.rows[touched(touch.rows)].seconds
    pressing = [row.force for row in touch.rows if first + 0.5 < row.seconds < first + 2.0]
    assert np.mean(pressing) == pytest.approx(FORCE, abs=0.5)
    assert np.nanmax([row.force for row in touch.rows]) < 15.0
    assert abs(made.tip[2] - HOLE[2]) < 0.001
    assert made.tip[0] > HOLE[0] + 0.01
    assert touch.contact is not None
    assert touch.contact.region is not None
    assert math.dist(touch.contact.region.center, TIP) < 1.5 * touch.contact.region.largest < 0.02
    if robot is arm:
        draw(tmp_path / "touch.png", touch.rows)
        assert (tmp_path / "touch.png").stat().st_size > 10_000


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_stops_while_the_sensor_is_disconnected(robot: Callable[[], Any]) -> None:
    made = robot()
    simulation, touch = simulated(made), Touch(made)
    perform(simulation, touch, lambda _: touch.rows and touch.rows[-1].force > FORCE / 2)
    simulation.command("disconnect")
    perform(simulation, touch, lambda reading: reading.condition is Condition.SENSOR_LOST)
    assert not made.velocity.any()
    blind = [row for row in touch.rows[touched(touch.rows) :] if row.condition is not Condition.FRESH]
    simulation.command("connect")
    perform(simulation, touch)
    assert np.nanmax([row.force for row in touch.rows]) < 15.0
    assert math.dist(blind[0].tip, blind[-1].tip) < 0.0005


def test_a_controller_that_is_wrong_by_sign_diverges() -> None:
    made: Any = SpringArm()
    simulation, touch = simulated(made), Touch(made)
    made.rotation = -made.rotation
    perform(simulation, touch, lambda _: touch.rows and abs(touch.rows[-1].force) > 5 * FORCE)
    assert made.tip[0] > HOLE[0]


@pytest.mark.parametrize("is_its_own", [True, False])
def test_a_server_whose_sensor_does_not_measure_what_is_sent_is_named(
    is_its_own: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent, path = [Felt((0.0,) * 6)], tmp_path / "world"
    if importlib.util.find_spec("mujoco") is None:
        monkeypatch.setitem(sys.modules, "mujoco", mock.Mock())
    example = importlib.import_module("docs.examples.mujoco.arm")
    channel = MemoryChannel(Simulation(world=lambda _: sent[-1] if is_its_own else sent[0]))
    world = mock.MagicMock()
    world.__enter__().send = lambda _, *felt: sent.append(Felt(*felt))
    for name, value in {
        "time": SimpleNamespace(
            monotonic=lambda: channel.monotonic_ns() * 1e-9,
            sleep=lambda seconds: channel.wait(threading.Event(), seconds),
        ),
        "signal": mock.Mock(),
        "World": lambda _: world,
        "Client": lambda port: Client(port, channel=channel).connect(),
    }.items():
        monkeypatch.setattr(example, name, value)
    robot = SimpleNamespace(step=lambda: sent[0], shown=contextlib.nullcontext)
    task = SimpleNamespace(done=False)
    task.update = lambda _, seconds: setattr(task, "done", seconds > 2.0)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(str(path))
        with contextlib.nullcontext() if is_its_own else pytest.raises(SystemExit) as error:
            example.perform(task, robot, argparse.Namespace(world=str(path), port=12001))
    assert task.done == is_its_own
    assert error is None or str(error.value) == (
        f"the sensor at port 12001 does not measure what is sent to {path}: start ethercat-server virtual "
        f'12001 --virtual "--world {path}", or give the --port of the server of that virtual sensor'
    )


@pytest.mark.long
def test_the_arm_identifies_its_tool() -> None:
    made = arm()
    task = identify.Identification(made)
    perform(simulated(made), task)
    payload = task.result().payload
    assert payload.mass == pytest.approx(identify.MASS, abs=0.01)
    assert math.dist(payload.center, identify.CENTER) < 0.002
