"""IV.1 to IV.5: the fast path against the equations on arrays, and against physics written elsewhere."""

from __future__ import annotations

import itertools
import math
import os
import time
import timeit
from collections.abc import Callable

import numpy as np
import pytest

from ethercat_server.virtual_sensor import signals
from ft_compensation.alignment import align
from ft_compensation.compensator import Compensator
from ft_compensation.quantities import ZERO, Payload, Wrench
from ft_compensation.specific_force import ImuSpecificForce
from tests.compensation import equations
from tests.compensation.motion import settings

CASES = 10_000 if "TEST_SEED" in os.environ else 2_000  # all of them in long runs


def test_the_fast_path_agrees_with_the_equations_in_thousands_of_cases() -> None:
    draw = np.random.default_rng(4)
    force, torque, center, bias = (draw.uniform(-1, 1, (CASES, n)) for n in (3, 3, 3, 6))
    mass, orientation = draw.uniform(0, 10, CASES), draw.normal(size=(CASES, 4))
    gravity = equations.gravity_in_sensor_from_quaternion(orientation, (0.2, -0.3, -9.8))
    force, torque, bias = 500 * force, 20 * torque, 100 * bias
    wanted = equations.compensate(force, torque, bias=bias, mass=mass, center=center, gravity=gravity)
    rows = zip(*(part.tolist() for part in (force, torque, center, bias, mass, gravity)), strict=True)
    got = []
    for f, m, c, b, kilograms, g in rows:
        compensator = Compensator(Payload(kilograms, (*c,)))
        compensator.bias = Wrench.of(b)
        stages = compensator.compensate((*f,), (*m,), (-g[0], -g[1], -g[2]))
        got.append([*stages.corrected.values, *stages.tool.values, *stages.final.values])
    assert np.abs(np.array(got) - np.hstack(wanted)).max() < 1e-9


def test_stages_add_up_and_have_their_signs() -> None:
    compensator = Compensator(Payload(1.0, (0.1, 0.2, 0.3)), Wrench.of(range(6)))
    measured = Wrench((5.0, 6.0, 7.0), (0.5, 0.6, 0.7))
    stages = compensator.compensate(*measured, (0.1, 0.2, 9.9))
    total = stages.bias.plus(stages.tool).plus(stages.final)
    assert total.values == pytest.approx(measured.values)
    assert stages.corrected.values == pytest.approx(measured.plus(stages.bias, -1.0).values)
    # Upright sensor, 1 kg: the load on the sensor points down, along gravity.
    stages = Compensator(Payload(1.0, ZERO)).compensate((0.0, 0.0, -9.8), ZERO, (0.0, 0.0, 9.8))
    assert stages.tool.force == (0.0, 0.0, -9.8)
    assert stages.final.force == ZERO
    # Rolled by 90° about x, what points along the sensor's y points up.
    rolled = 3.0 * np.array((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)))
    assert equations.matrix_from_quaternion(rolled) @ (0, 1, 0) == pytest.approx([0, 0, 1], abs=1e-12)


@pytest.mark.parametrize("seconds", [0.0, 2.7, 5.3, 11.0])
def test_signs_are_those_of_the_sensor(seconds: float) -> None:
    """The scene's tool, from physics written elsewhere: what is left is the contact, and nothing else."""
    felt = signals.scene(seconds)
    fx, fy, fz, mx, my, mz = felt.wrench
    ax, ay, az = felt.acceleration
    stages = Compensator(Payload(signals.TOOL_MASS, signals.TOOL_CENTRE)).compensate(
        (fx, fy, fz), (mx, my, mz), (ax, ay, az)
    )
    contact = signals.contact_force(seconds)
    assert stages.final.force == pytest.approx(contact, abs=1e-9)
    assert stages.final.torque == pytest.approx(signals.cross(signals.CONTACT_POINT, contact), abs=1e-9)


def test_compensation_is_quick() -> None:
    """Far below the 20 us that a sample may cost, where adding up a thousand integers takes 10 us."""
    compensator, alignment = Compensator(Payload(1.0, (0.1, 0.2, 0.3))), align(settings(), 800.0)
    imu = ImuSpecificForce((0.1, 0.2, 0.3), alignment=alignment)
    v, still, times = (1.0, 2.0, 3.0), ZERO, itertools.count()

    def cost(call: Callable[[], object]) -> float:
        return min(timeit.repeat(call, timer=time.thread_time, number=200, repeat=20))

    def compensate() -> None:
        felt = imu.follow(v, still, next(times) / 800)
        assert felt is not None
        compensator.compensate(v, v, felt)

    assert cost(compensate) < 2 * cost(lambda: sum(range(1000)))
