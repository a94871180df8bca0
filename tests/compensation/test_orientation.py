"""Where gravity points by orientations: carried on by the gyroscope, and what is stale."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from ft_compensation.orientation import QuaternionGravity
from ft_compensation.quantities import DEFAULT_GRAVITY
from tests.compensation import equations

G = STANDARD_GRAVITY
UPRIGHT = (0.0, 0.0, G)
STILL = (0.0, 0.0, 0.0)
RATE = 800


def angle(a: Vector3, b: Vector3) -> float:
    cosine = sum(x * y for x, y in zip(a, b, strict=True)) / math.hypot(*a) / math.hypot(*b)
    return math.acos(min(1.0, cosine))


def about_x(turned: float) -> Vector3:
    """What the accelerometer reads after the sensor has turned about its x axis."""
    return 0.0, G * math.sin(turned), G * math.cos(turned)


def down(acceleration: Vector3) -> Vector3:
    x, y, z = acceleration
    return -x, -y, -z


# Orientations.


def quaternion_about(axis: Vector3, turned: float) -> tuple[float, float, float, float]:
    x, y, z = (math.sin(turned / 2) * part for part in axis)
    return x, y, z, math.cos(turned / 2)


def test_a_quaternion_turns_the_sensor_into_the_base() -> None:
    """Rolled by +90° about x, the sensor's y points up: gravity is along -y."""
    source = QuaternionGravity()
    assert source.update(quaternion_about((1.0, 0.0, 0.0), math.pi / 2), 1.0)
    assert source.gravity(1.0) == pytest.approx((0.0, -G, 0.0))


def test_quaternions_agree_with_the_equations() -> None:
    draw = np.random.default_rng(3)
    source = QuaternionGravity((0.3, -0.2, -9.7))
    for number, q in enumerate(draw.normal(size=(500, 4))):
        x, y, z, w = (q / np.linalg.norm(q) * draw.uniform(0.9, 1.1)).tolist()
        assert source.update((x, y, z, w), float(number))
        wanted = equations.gravity_in_sensor_from_quaternion(q, (0.3, -0.2, -9.7))
        assert source.gravity(float(number)) == pytest.approx(wanted.tolist(), abs=1e-12)


@pytest.mark.parametrize("bad", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 5.0)])
def test_what_is_no_orientation_is_not_taken(bad: tuple[float, float, float, float]) -> None:
    source = QuaternionGravity()
    assert not source.update(bad, 1.0)
    assert source.gravity(1.0) is None


def test_an_older_orientation_does_not_replace_a_newer_one() -> None:
    source = QuaternionGravity(stale_after_s=0.1)
    source.update((0.0, 0.0, 0.0, 1.0), 1.0)
    assert not source.update((1.0, 0.0, 0.0, 0.0), 0.95)
    assert source.gravity(1.0) == pytest.approx(DEFAULT_GRAVITY)
    assert source.update((1.0, 0.0, 0.0, 0.0), 0.5), "unless the clock was set back"


def test_it_does_not_go_on_with_an_old_pose() -> None:
    source = QuaternionGravity(stale_after_s=0.25)
    source.update((0.0, 0.0, 0.0, 1.0), 10.0)
    answers = [source.gravity(now) is not None for now in (10.0, 10.25, 10.26, 1000.0, 9.7)]
    assert answers == [True, True, False, False, False]
    assert source.age_s(10.2) == pytest.approx(0.2)


# Orientations that are older or newer than the sample.


def arm(turned: float) -> tuple[float, float, float, float]:
    """The orientation of a sensor that has turned about its x axis by so much."""
    return quaternion_about((1.0, 0.0, 0.0), turned)


@pytest.mark.parametrize("late_s", [0.0, 0.004, 0.0505, -0.003])
def test_an_orientation_is_carried_on_to_the_samples_time(late_s: float) -> None:
    """A robot that turns by 2 rad/s tells its pose at 100 Hz, and late; or early, as its clock is ahead."""
    source, speed, errors = QuaternionGravity(), 2.0, []
    for number in range(RATE):
        t = number / RATE
        source.follow((speed, 0.0, 0.0), t)
        if number % 8 == 0:
            source.update(arm(speed * (t - late_s)), t - late_s)
        got = source.gravity(t)
        if t > 0.1:
            assert got is not None
            errors.append(angle(got, down(about_x(speed * t))))
    assert max(errors) < 2e-5, "held, it would be off by 2 rad/s times its age: up to 0.12 rad"


def test_an_orientation_is_held_where_the_gyroscope_is_of_no_use() -> None:
    source = QuaternionGravity()
    source.follow((2.0, 0.0, 0.0), 1.0)
    source.update(arm(0.0), 1.0)
    source.follow((math.nan, 0.0, 0.0), 1.01)
    assert source.gravity(1.05) == pytest.approx(DEFAULT_GRAVITY)
    for time_s in (1.02, 9.0, 1.0):  # a gap; and a clock that was set back
        source.follow((2.0, 0.0, 0.0), time_s)
    assert source.gravity(1.05) == pytest.approx(DEFAULT_GRAVITY)
