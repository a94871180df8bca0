"""IV.1 to IV.5: against loops written from the note alone, and the fast path against the arrays."""

from __future__ import annotations

import itertools
import math
import os
import random
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from ethercat_server.virtual_sensor.measurement import scene
from ft_compensation.compensator import Compensator
from ft_compensation.quantities import ZERO, Payload, Wrench
from ft_compensation.specific_force import ImuSpecificForce
from protocol.pdo import STANDARD_GRAVITY
from tests.compensation import equations

CASES = 10_000 if "TEST_SEED" in os.environ else 2_000
"""All of them in long runs."""
AGREEMENT = 1e-9

Rows = list[list[float]]


def rotation_about(axis: int, angle: float) -> Rows:
    """Turns vectors by `angle` about a coordinate axis."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rows = [[float(a == b) for b in range(3)] for a in range(3)]
    rows[i][i], rows[i][j], rows[j][i], rows[j][j] = c, -s, s, c
    return rows


def product(a: Rows, b: Rows) -> Rows:
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def times(a: Rows, v: list[float]) -> list[float]:
    return [sum(a[i][k] * v[k] for k in range(3)) for i in range(3)]


def half_turn_quaternion(axis: int, angle: float) -> list[float]:
    q = [0.0, 0.0, 0.0, math.cos(angle / 2)]
    q[axis] = math.sin(angle / 2)
    return q


def hamilton(p: list[float], q: list[float]) -> list[float]:
    """The product of quaternions x, y, z, w: turns by q first, then by p."""
    px, py, pz, pw = p
    qx, qy, qz, qw = q
    return [
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
        pw * qw - px * qx - py * qy - pz * qz,
    ]


class Case(NamedTuple):
    """A random case and what the note's equations make of it."""

    force: list[float]
    torque: list[float]
    bias: list[float]
    mass: float
    center: list[float]
    gravity: list[float]
    base_r_sensor: Rows
    orientation: list[float]
    gravity_in_sensor: list[float]
    gravity_force: list[float]
    gravity_torque: list[float]
    final_force: list[float]
    final_torque: list[float]


def make_case(draw: random.Random) -> Case:
    def three(size: float) -> list[float]:
        return [draw.uniform(-size, size) for _ in range(3)]

    force, torque, bias = three(500), three(20), three(100) + three(5)
    mass, center = draw.uniform(0, 10), three(0.3)
    gravity = [*three(0.5)[:2], -draw.uniform(9.7, 9.9)]
    base_r_sensor = [[float(a == b) for b in range(3)] for a in range(3)]
    orientation = [0.0, 0.0, 0.0, 1.0]
    for axis in (2, 1, 0):
        angle = draw.uniform(-math.pi, math.pi)
        base_r_sensor = product(base_r_sensor, rotation_about(axis, angle))
        orientation = hamilton(orientation, half_turn_quaternion(axis, angle))
    # IV.2: from base to sensor is the inverse, which for a rotation is the transpose.
    g = times([list(column) for column in zip(*base_r_sensor, strict=True)], gravity)
    weight = [mass * part for part in g]  # IV.3
    moment = [  # IV.4
        center[1] * weight[2] - center[2] * weight[1],
        center[2] * weight[0] - center[0] * weight[2],
        center[0] * weight[1] - center[1] * weight[0],
    ]
    return Case(
        force, torque, bias, mass, center, gravity, base_r_sensor, orientation, g, weight, moment,
        [force[i] - bias[i] - weight[i] for i in range(3)],  # IV.1 and IV.5
        [torque[i] - bias[3 + i] - moment[i] for i in range(3)],
    )  # fmt: skip


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    draw = random.Random(4)
    return [make_case(draw) for _ in range(CASES)]


def column(cases: list[Case], name: str) -> equations.Array:
    return np.array([getattr(case, name) for case in cases])


def test_arrays_agree_with_the_note_in_thousands_of_cases(cases: list[Case]) -> None:
    sensor_r_base = np.swapaxes(column(cases, "base_r_sensor"), 1, 2)
    gravity = equations.gravity_in_sensor(sensor_r_base, column(cases, "gravity"))
    assert np.abs(gravity - column(cases, "gravity_in_sensor")).max() < AGREEMENT
    stages = equations.compensate(
        column(cases, "force"),
        column(cases, "torque"),
        bias=column(cases, "bias"),
        mass=column(cases, "mass"),
        center=column(cases, "center"),
        gravity=gravity,
    )
    for name in ("gravity_force", "gravity_torque", "final_force", "final_torque"):
        got = getattr(stages, name)
        assert got.shape == (CASES, 3)
        assert np.abs(got - column(cases, name)).max() < AGREEMENT, name
    assert not stages.inertia_force.any()


def test_quaternions_agree_with_matrices(cases: list[Case]) -> None:
    orientation = column(cases, "orientation")
    assert (
        np.abs(equations.matrix_from_quaternion(orientation) - column(cases, "base_r_sensor")).max()
        < AGREEMENT
    )
    gravity = equations.gravity_in_sensor_from_quaternion(orientation * 3.0, column(cases, "gravity"))
    assert np.abs(gravity - column(cases, "gravity_in_sensor")).max() < AGREEMENT


def test_one_sample_is_a_row_of_the_array(cases: list[Case]) -> None:
    case = cases[0]
    g = equations.gravity_in_sensor_from_quaternion(case.orientation, case.gravity)
    assert g.shape == (3,)
    stages = equations.compensate(
        case.force, case.torque, bias=case.bias, mass=case.mass, center=case.center, gravity=g
    )
    assert stages.final_torque.shape == (3,)
    assert stages.final_torque.tolist() == pytest.approx(case.final_torque, abs=AGREEMENT)


def test_the_fast_path_agrees_in_thousands_of_cases(cases: list[Case]) -> None:
    for case in cases:
        compensator = Compensator(Payload.of(case.mass, case.center))
        compensator.set_bias(Wrench.of(case.bias))
        (fx, fy, fz), (mx, my, mz), (gx, gy, gz) = case.force, case.torque, case.gravity_in_sensor
        stages = compensator.compensate((fx, fy, fz), (mx, my, mz), (-gx, -gy, -gz))
        for got, wanted in (
            (stages.tool, [*case.gravity_force, *case.gravity_torque]),
            (stages.final, [*case.final_force, *case.final_torque]),
        ):
            assert max(abs(a - b) for a, b in zip(got.values, wanted, strict=True)) < AGREEMENT


def test_weight_and_inertia_are_the_same_on_both_paths() -> None:
    """The specific force at the center of gravity has both in it, whatever gravity is."""
    draw = np.random.default_rng(5)
    n = 200
    force, torque, gravity, acceleration, rate = draw.normal(0, 5, (5, n, 3))
    imu, center, bias = (0.01, 0.02, -0.0257), (0.03, -0.02, 0.1), draw.normal(0, 1, 6)
    arrays = equations.compensate(
        force, torque, bias=bias, mass=1.7, center=center, gravity=gravity,
        acceleration=acceleration, angular_rate=rate, imu_position=imu,
    )  # fmt: skip
    lever = (center[0] - imu[0], center[1] - imu[1], center[2] - imu[2])
    compensator = Compensator(Payload(1.7, center), Wrench.of(bias))
    for i in range(n):
        felt = ImuSpecificForce(lever).follow((*acceleration[i].tolist(),), (*rate[i].tolist(),), 0.0)
        assert felt is not None
        stages = compensator.compensate((*force[i].tolist(),), (*torque[i].tolist(),), felt)
        both = arrays.gravity_force[i] + arrays.inertia_force[i]
        assert stages.corrected.force == pytest.approx(arrays.corrected_force[i], abs=AGREEMENT)
        assert stages.tool.force == pytest.approx(both, abs=AGREEMENT)
        assert stages.final.force == pytest.approx(arrays.final_force[i], abs=AGREEMENT)
        assert stages.final.torque == pytest.approx(arrays.final_torque[i], abs=AGREEMENT)


def test_a_spinning_tool_pulls_outward() -> None:
    """On a turntable (about z, IMU on the axis) a mass at radius r pulls with m omega² r."""
    force = equations.inertial_force(2.0, (0.1, 0.0, 0.0), (0.0, 0.0, -9.8), (0.0, 0.0, 9.8), (0.0, 0.0, 3.0))
    assert force.tolist() == pytest.approx([2.0 * 9.0 * 0.1, 0.0, 0.0])


def test_angular_acceleration_where_it_is_known() -> None:
    """Spun up about z with alpha, a mass at r resists with -m alpha x r."""
    force = equations.inertial_force(
        2.0, (0.1, 0.0, 0.0), (0.0, 0.0, -9.8), (0.0, 0.0, 9.8), angular_acceleration=(0.0, 0.0, 5.0)
    )
    assert force.tolist() == pytest.approx([0.0, -1.0, 0.0])


def test_every_stage_adds_up_to_what_was_measured() -> None:
    compensator = Compensator(Payload(1.0, (0.1, 0.2, 0.3)), Wrench.of(range(6)))
    measured = Wrench((5.0, 6.0, 7.0), (0.5, 0.6, 0.7))
    stages = compensator.compensate(*measured, (0.1, 0.2, 9.9))
    for i in range(6):
        parts = [part.values[i] for part in (stages.bias, stages.tool, stages.final)]
        assert sum(parts) == pytest.approx(measured.values[i])
        assert stages.corrected.values[i] == pytest.approx(measured.values[i] - parts[0])


@pytest.mark.parametrize("seconds", [0.0, 2.7, 5.3, 11.0])
def test_signs_are_those_of_the_sensor(seconds: float) -> None:
    """The scene's tool, from physics written elsewhere: what is left is the contact, and nothing else."""
    reading = scene.Scene(0, noise=False).reading(0, 0, seconds)
    fx, fy, fz, mx, my, mz = reading.force_torque
    ax, ay, az = (STANDARD_GRAVITY * part for part in reading.acceleration)
    stages = Compensator(Payload(scene.TOOL_MASS, scene.TOOL_CENTRE)).compensate(
        (fx, fy, fz), (mx, my, mz), (ax, ay, az)
    )
    contact = scene.contact_force(seconds)
    assert stages.final.force == pytest.approx(contact, abs=1e-9)
    assert stages.final.torque == pytest.approx(scene.cross(scene.CONTACT_POINT, contact), abs=1e-9)


def test_a_hanging_tool_pulls_down() -> None:
    """Upright sensor, 1 kg: the load on the sensor points down, along gravity."""
    stages = Compensator(Payload(1.0, ZERO)).compensate((0.0, 0.0, -9.8), ZERO, (0.0, 0.0, 9.8))
    assert stages.tool.force == (0.0, 0.0, -9.8)
    assert stages.final.force == ZERO


def test_no_orientation_is_an_error() -> None:
    with pytest.raises(ValueError, match="length 0"):
        equations.matrix_from_quaternion((0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("mass", "center", "message"),
    [
        (-1.0, ZERO, "cannot be negative: -1 kg"),
        (math.nan, ZERO, "a mass is a finite number"),
        ("heavy", ZERO, "a mass is a finite number"),
        (1.0, (0.0, 1.0), "a center of gravity is 3 finite numbers"),
        (1.0, None, "a center of gravity is 3 finite numbers, not None"),
    ],
)
def test_what_is_no_payload_is_a_sentence(mass: object, center: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Payload.of(mass, center)


def test_compensation_is_quick() -> None:
    """Far below the 20 us that a sample may cost, where adding up a thousand integers takes 10 us."""
    import time
    import timeit

    compensator, imu = Compensator(Payload(1.0, (0.1, 0.2, 0.3))), ImuSpecificForce((0.1, 0.2, 0.3))
    v = (1.0, 2.0, 3.0)

    def cost(call: Callable[[], object]) -> float:
        return min(timeit.repeat(call, timer=time.thread_time, number=200, repeat=20))

    times = itertools.count()

    def compensate() -> None:
        felt = imu.follow(v, v, next(times) / 800)
        assert felt is not None
        compensator.compensate(v, v, felt)

    assert cost(compensate) < 2 * cost(lambda: sum(range(1000)))
