"""Where gravity points: the accelerometer's filter, its gate and its lag; orientations; and what is stale."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from ft_compensation.orientation import AccelerometerGravity, QuaternionGravity
from ft_compensation.quantities import DEFAULT_GRAVITY
from protocol.pdo import STANDARD_GRAVITY, Vector3
from tests.compensation import equations

G = STANDARD_GRAVITY
UPRIGHT = (0.0, 0.0, G)
STILL = (0.0, 0.0, 0.0)
RATE = 800
Source = AccelerometerGravity | QuaternionGravity


def angle(a: Vector3, b: Vector3) -> float:
    cosine = sum(x * y for x, y in zip(a, b, strict=True)) / math.hypot(*a) / math.hypot(*b)
    return math.acos(min(1.0, cosine))


def about_x(turned: float) -> Vector3:
    """What the accelerometer reads after the sensor has turned about its x axis."""
    return 0.0, G * math.sin(turned), G * math.cos(turned)


def down(acceleration: Vector3) -> Vector3:
    x, y, z = acceleration
    return -x, -y, -z


def turning(source: AccelerometerGravity, speed: float, seconds: float, offset: float = 0.0) -> float:
    """Feed a steady turn about x; returns how far behind the truth the answer is at its end, rad."""
    for number in range(int(seconds * RATE) + 1):
        t = number / RATE
        source.update(about_x(speed * t), (speed + offset, 0.0, 0.0), t)
    got = source.gravity(t)
    assert got is not None
    return math.remainder(speed * t - math.atan2(-got[1], -got[2]), math.tau)


def test_at_rest_it_is_minus_the_acceleration() -> None:
    source = AccelerometerGravity()
    assert source.update((3.0, 4.0, 8.0), STILL, 1.0)
    got = source.gravity(1.0)
    assert got is not None
    assert math.hypot(*got) == pytest.approx(G), "the length is gravity's, whatever the accelerometer's scale"
    assert angle(got, (-3.0, -4.0, -8.0)) == pytest.approx(0.0, abs=1e-7)


def test_it_knows_nothing_at_first() -> None:
    for source in (AccelerometerGravity(), QuaternionGravity()):
        assert source.gravity(0.0) is None
        assert source.age_s(0.0) == math.inf


def test_noise_is_filtered() -> None:
    noise = random.Random(1)
    source = AccelerometerGravity(time_constant_s=0.5)
    errors = []
    for number in range(4 * RATE):
        t = number / RATE
        x, y, z = (part + noise.gauss(0.0, 0.05) for part in UPRIGHT)
        source.update((x, y, z), STILL, t)
        got = source.gravity(t)
        assert got is not None
        errors.append(angle(got, (0.0, 0.0, -1.0)))
    assert max(errors[RATE:]) < 0.1 * max(errors[:5])


def test_the_lag_without_the_gyroscope_is_the_time_constant_and_none_with_it() -> None:
    speed = 0.2
    without = AccelerometerGravity(gyroscope=False, time_constant_s=0.3)
    assert turning(without, speed, 4.0) / speed == pytest.approx(0.3, rel=0.02)
    with_it = AccelerometerGravity(gyroscope=True, time_constant_s=0.3)
    assert turning(with_it, speed, 4.0) == pytest.approx(0.0, abs=1e-6)
    assert turning(AccelerometerGravity(), 3.0, 4.0) == pytest.approx(0.0, abs=1e-4)


def test_the_filter_goes_by_time_not_by_count() -> None:
    """The same turn at 1600 Hz and at 100 Hz, and with half of the samples lost, gives the same lag."""

    def lag(times: list[float]) -> float:
        source = AccelerometerGravity(gyroscope=False, time_constant_s=0.3)
        for t in times:
            source.update(about_x(0.2 * t), STILL, t)
        got = source.gravity(times[-1])
        assert got is not None
        return times[-1] - math.atan2(-got[1], -got[2]) / 0.2

    draw = random.Random(2)
    fast = [k / 1600 for k in range(6400)]
    for times in ([k / 100 for k in range(400)], sorted(draw.sample(fast, 3200))):
        assert lag(times) == pytest.approx(lag(fast), abs=0.01)


def test_a_gyroscope_offset_tilts_it_by_the_time_constant_and_can_be_taken_out() -> None:
    source = AccelerometerGravity(time_constant_s=0.5)
    assert abs(turning(source, 0.0, 5.0, offset=0.02)) == pytest.approx(0.01, rel=0.05)
    source = AccelerometerGravity(time_constant_s=0.5, angular_rate_offset=(0.02, 0.0, 0.0))
    assert turning(source, 0.3, 5.0, offset=0.02) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("gyroscope", [True, False])
def test_a_jerk_does_not_count(gyroscope: bool) -> None:
    source = AccelerometerGravity(gyroscope=gyroscope, gate=0.5)
    source.update(UPRIGHT, STILL, 0.0)
    for number in range(1, 100):
        assert not source.update((4.0, 0.0, G), STILL, number / RATE)
    assert source.rejected == 99
    assert source.gravity(99 / RATE) == pytest.approx(down(UPRIGHT))


def test_a_jerk_that_lasts_makes_it_stale_and_it_begins_anew_afterwards() -> None:
    source = AccelerometerGravity(stale_after_s=0.5)
    source.update(UPRIGHT, STILL, 0.0)
    t = 0.0
    while t < 0.45:
        t += 1 / RATE
        source.update((9.0, 0.0, G), STILL, t)
    assert source.gravity(t) is not None
    while t < 0.55:
        t += 1 / RATE
        source.update((9.0, 0.0, G), STILL, t)
    assert source.gravity(t) is None
    assert source.age_s(t) == pytest.approx(t)
    assert source.update((G, 0.0, 0.0), STILL, t + 0.01)
    assert source.gravity(t + 0.01) == pytest.approx((-G, 0.0, 0.0)), "nothing of the old pose is left"


@pytest.mark.parametrize(
    ("acceleration", "rate"),
    [((math.nan, 0.0, G), STILL), (UPRIGHT, (0.0, math.nan, 0.0)), ((math.inf, 0.0, 0.0), STILL)],
)
def test_numbers_that_are_not_finite_do_no_lasting_harm(acceleration: Vector3, rate: Vector3) -> None:
    source = AccelerometerGravity()
    source.update(UPRIGHT, STILL, 0.0)
    assert not source.update(acceleration, rate, 0.1)
    assert source.update(UPRIGHT, STILL, 0.2)
    assert source.gravity(0.2) == pytest.approx(down(UPRIGHT))


def test_an_imu_that_is_off_gives_no_gravity() -> None:
    source = AccelerometerGravity()
    assert not source.update((0.0, 0.0, 0.0), STILL, 0.0)
    assert source.gravity(0.0) is None


def test_a_clock_that_jumps_back_begins_anew() -> None:
    source = AccelerometerGravity()
    source.update(UPRIGHT, STILL, 100.0)
    source.update((G, 0.0, 0.0), STILL, 5.0)
    assert source.gravity(5.0) == pytest.approx((-G, 0.0, 0.0))
    assert source.gravity(100.0) is None


def test_two_samples_of_one_time_and_one_a_hair_early_do_no_harm() -> None:
    source = AccelerometerGravity()
    for time_s in (1.0, 1.0, 1.2, 1.1999, 1.1999):
        assert source.update(UPRIGHT, STILL, time_s)
    assert source.gravity(1.2) == pytest.approx(down(UPRIGHT))
    tilted = about_x(0.3)
    source.update(tilted, STILL, 1.1998)
    assert source.gravity(1.2) == pytest.approx(down(UPRIGHT)), "it does not begin anew"


def test_directions_that_contradict_each_other_are_none() -> None:
    source = AccelerometerGravity(gyroscope=False, time_constant_s=10.0)
    for number in range(20):
        source.update((0.0, 0.0, G if number % 2 else -G), STILL, number * 0.01)
    assert source.gravity(0.19) is None


@pytest.mark.parametrize("wrong", [{"time_constant_s": 0.0}, {"magnitude": 0.0}])
def test_a_filter_without_time_constant_or_gravity_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be greater than 0"):
        AccelerometerGravity(**wrong)  # type: ignore[arg-type]


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


def feed_accelerometer(source: Source, t: float) -> None:
    assert isinstance(source, AccelerometerGravity)
    assert source.update(UPRIGHT, STILL, t)


def feed_quaternion(source: Source, t: float) -> None:
    assert isinstance(source, QuaternionGravity)
    assert source.update((0.0, 0.0, 0.0, 1.0), t)


@pytest.mark.parametrize(
    ("source", "feed"),
    [
        (AccelerometerGravity(stale_after_s=0.25), feed_accelerometer),
        (QuaternionGravity(stale_after_s=0.25), feed_quaternion),
    ],
)
def test_no_source_goes_on_with_an_old_pose(
    source: Source,
    feed: Callable[[Source, float], None],
) -> None:
    answers = []
    feed(source, 10.0)
    for now in (10.0, 10.25, 10.26, 1000.0, 9.7):
        answers.append(source.gravity(now) is not None)
    assert answers == [True, True, False, False, False]
    assert source.age_s(10.2) == pytest.approx(0.2)
    feed(source, 20.0)
    assert source.gravity(20.1) is not None


def test_a_short_gap_is_bridged_by_the_gyroscope() -> None:
    """Samples lost for 0.2 s in a turn: the rate of the next sample covers them to first order."""
    source = AccelerometerGravity()
    times = [t for t in (k / RATE for k in range(2 * RATE)) if not 1.0 < t < 1.2]
    for before, t in pairwise(times):
        assert t > before
        source.update(about_x(0.5 * t), (0.5, 0.0, 0.0), t)
    got = source.gravity(times[-1])
    assert got is not None
    assert angle(got, down(about_x(0.5 * times[-1]))) < 1e-3
