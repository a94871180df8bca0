"""Where gravity points: what the accelerometer is believed, orientations, and what is stale."""

from __future__ import annotations

import math
from collections.abc import Callable

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


def angle(a: Vector3, b: Vector3) -> float:
    cosine = sum(x * y for x, y in zip(a, b, strict=True)) / math.hypot(*a) / math.hypot(*b)
    return math.acos(min(1.0, cosine))


def about_x(turned: float) -> Vector3:
    """What the accelerometer reads after the sensor has turned about its x axis."""
    return 0.0, G * math.sin(turned), G * math.cos(turned)


def down(acceleration: Vector3) -> Vector3:
    x, y, z = acceleration
    return -x, -y, -z


def feed(
    source: AccelerometerGravity,
    seconds: float,
    begin_s: float = 0.0,
    acceleration: Vector3 | Callable[[float], Vector3] = UPRIGHT,
    rate: Vector3 = STILL,
) -> float:
    """Feed samples; returns the time of the last one. A callable is given the time since `begin_s`."""
    t = begin_s
    for number in range(int(seconds * RATE) + 1):
        t = begin_s + number / RATE
        source.update(acceleration(number / RATE) if callable(acceleration) else acceleration, rate, t)
    return t


def resting(**options: float) -> tuple[AccelerometerGravity, float]:
    """One that knows an upright sensor, and the time."""
    source = AccelerometerGravity(**options)  # type: ignore[arg-type]
    return source, feed(source, 2.0)


def tilt(source: AccelerometerGravity, t: float, truth: Vector3 = UPRIGHT) -> float:
    """How far the answer is off, rad."""
    got = source.gravity(t)
    assert got is not None
    return angle(got, down(truth))


def test_at_rest_it_is_minus_the_acceleration() -> None:
    source = AccelerometerGravity()
    t = feed(source, 3.0, 1.0, (3.0, 4.0, 8.0))
    got = source.gravity(t)
    assert got is not None
    assert math.hypot(*got) == pytest.approx(G), "the length is gravity's, whatever the accelerometer's scale"
    assert angle(got, (-3.0, -4.0, -8.0)) == pytest.approx(0.0, abs=1e-6)


def test_it_knows_nothing_at_first() -> None:
    for source in (AccelerometerGravity(), QuaternionGravity()):
        assert source.gravity(0.0) is None
        assert source.age_s(0.0) == math.inf


def test_it_answers_within_a_second_of_rest_and_not_before_it_can_know() -> None:
    source = AccelerometerGravity()
    t = feed(source, 0.3)
    assert source.gravity(t) is None
    assert source.tilt_95 > 0.07
    t = feed(source, 0.7, t)
    assert source.gravity(t) is not None
    assert source.tilt_95 < 0.07


def test_a_start_in_an_acceleration_is_no_answer() -> None:
    """2.5 m/s² for a second, as constant as gravity: 14° that nothing but waiting tells apart."""
    source = AccelerometerGravity()
    for number in range(RATE):
        source.update((2.5, 0.0, G), STILL, number / RATE)
        assert source.gravity(number / RATE) is None
    t = feed(source, 2.0, 1.0)
    assert tilt(source, t) < 0.02


def test_it_does_not_lag_behind_a_turn() -> None:
    source, t = resting()
    feed(source, 4.0, t, lambda s: about_x(2.0 * s), (2.0, 0.0, 0.0))
    assert tilt(source, t + 4.0, about_x(8.0)) < 0.003


@pytest.mark.parametrize("step", [1, 2, 8])
def test_it_goes_by_time_and_not_by_count(step: int) -> None:
    """Every sample, every second one, and 100 Hz."""
    source = AccelerometerGravity()
    for number in range(0, 4 * RATE, step):
        t = number / RATE
        turned = 2.0 * max(0.0, t - 2.0)
        source.update(about_x(turned), (2.0 if t > 2.0 else 0.0, 0.0, 0.0), t)
    assert tilt(source, t, about_x(turned)) < 0.012


def test_the_offset_of_the_gyroscope_is_learned_at_rest() -> None:
    source, offset = AccelerometerGravity(), (0.02, -0.02, 0.0)
    t = feed(source, 3.0, rate=offset)
    assert source.offset.value == pytest.approx(offset, abs=5e-4)
    # Now nothing but the gyroscope counts.
    t = feed(source, 1.0, t, (5.0, 0.0, G), offset)
    assert tilt(source, t) < 0.004


def test_the_offset_along_gravity_is_not_learned_and_stays_uncertain() -> None:
    """A slow turn about the vertical passes for rest: as an offset it would tilt gravity in another pose."""
    source = AccelerometerGravity()
    t = feed(source, 5.0, rate=(0.0, 0.0, 0.05))
    assert source.offset.value == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    # It stops, and is rolled over by a quarter in half a second: no tilt, and the uncertainty is told.
    t = feed(source, 0.5, t)
    t = feed(source, 0.5, t, lambda s: about_x(math.pi * s), (math.pi, 0.0, 0.0))
    assert tilt(source, t, about_x(math.pi / 2)) < 0.005
    t = feed(source, 2.0, t, about_x(math.pi / 2))
    assert tilt(source, t, about_x(math.pi / 2)) < 0.002


def test_another_pose_shows_what_was_the_offset_along_gravity() -> None:
    source, offset = AccelerometerGravity(), (0.0, 0.0, 0.03)
    t = feed(source, 3.0, rate=offset)
    t = feed(source, 0.5, t, lambda s: about_x(math.pi * s), (math.pi, 0.0, 0.03))
    t = feed(source, 3.0, t, about_x(math.pi / 2), offset)
    assert source.offset.value == pytest.approx(offset, abs=1e-3)


def test_the_offset_is_not_learned_while_the_sensor_turns() -> None:
    source, t = resting()
    known = source.offset.value
    feed(source, 3.0, t, lambda s: about_x(1.0 * s), (1.01, 0.0, 0.0))  # its scale is off by 1 %
    assert source.offset.value == pytest.approx(known, abs=1e-4)


@pytest.mark.parametrize(
    "acceleration", [(5.0, 0.0, G), (0.0, -2.5, G), (1.0, 1.0, G - 0.1), (0.0, 0.0, 2 * G)]
)
def test_an_acceleration_does_not_count_and_the_uncertainty_grows(acceleration: Vector3) -> None:
    source, t = resting()
    before = source.tilt_95
    t = feed(source, 1.0, t, acceleration)
    assert source.age_s(t) == pytest.approx(1.0, abs=0.06)
    assert tilt(source, t) < 1e-3
    assert source.tilt_95 > before
    t = feed(source, 1.0, t)
    assert source.age_s(t) < 0.06


def test_what_contradicts_steadily_for_long_is_right() -> None:
    """The sensor was turned while its gyroscope was off the range, say."""
    source, t = resting()
    t = feed(source, 1.4, t, about_x(0.5))
    assert tilt(source, t) < 1e-3
    t = feed(source, 0.8, t, about_x(0.5))
    assert tilt(source, t, about_x(0.5)) < 1e-3


def test_it_stops_when_the_tilt_may_be_beyond_its_limit() -> None:
    source, t = resting(tilt_limit=0.1)
    while t < 20.0 and source.gravity(t) is not None:
        t = feed(source, 0.05, t, (9.0, 0.0, G))
    assert 2.5 < t < 20.0
    assert source.tilt_95 > 0.1


@pytest.mark.parametrize(
    ("acceleration", "rate"),
    [
        ((math.nan, 0.0, G), STILL),
        (UPRIGHT, (0.0, math.nan, 0.0)),
        ((math.inf, 0.0, 0.0), STILL),
        (UPRIGHT, (0.0, 3e38, 0.0)),
    ],
)
def test_numbers_that_cannot_be_do_no_lasting_harm(acceleration: Vector3, rate: Vector3) -> None:
    source, t = resting()
    assert not source.update(acceleration, rate, t + 0.1)
    assert source.update(UPRIGHT, STILL, t + 0.2)
    assert tilt(source, t + 0.2) < 1e-6


def test_the_largest_numbers_only_do_not_count() -> None:
    source, t = resting()
    t = feed(source, 0.2, t, (3e38, -3e38, 3e38), (99.0, 0.0, 0.0))
    feed(source, 3.0, t)
    assert tilt(source, t + 3.0) < 1e-3


def test_a_saturated_accelerometer_leaves_the_gyroscope() -> None:
    source, t = resting()
    for number in range(RATE):
        source.update(None, (1.0, 0.0, 0.0), t + number / RATE)
    t += number / RATE
    assert tilt(source, t, about_x(number / RATE)) < 2e-3


def test_an_imu_that_is_off_gives_no_gravity() -> None:
    source = AccelerometerGravity()
    assert not source.update((0.0, 0.0, 0.0), STILL, 0.0)
    assert source.gravity(0.0) is None


def test_a_clock_that_jumps_back_begins_anew() -> None:
    source = AccelerometerGravity()
    feed(source, 1.0, 100.0)
    t = feed(source, 1.0, 5.0, (G, 0.0, 0.0))
    assert source.gravity(t) == pytest.approx((-G, 0.0, 0.0), abs=1e-6)
    assert source.gravity(101.0) is None


def test_two_samples_of_one_time_and_one_a_hair_early_do_no_harm() -> None:
    source, t = resting()
    for time_s in (t, t, t + 0.2, t + 0.1999, t + 0.1999):
        assert source.update(UPRIGHT, STILL, time_s)
    assert tilt(source, t + 0.2) < 1e-6, "it does not begin anew"


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


def test_no_source_goes_on_with_an_old_pose() -> None:
    accelerometer, quaternion = (
        AccelerometerGravity(stale_after_s=0.25),
        QuaternionGravity(stale_after_s=0.25),
    )
    assert feed(accelerometer, 2.0, 8.0) == 10.0
    quaternion.update((0.0, 0.0, 0.0, 1.0), 10.0)
    for source in (accelerometer, quaternion):
        answers = [source.gravity(now) is not None for now in (10.0, 10.25, 10.26, 1000.0, 9.7)]
        assert answers == [True, True, False, False, False]
        assert source.age_s(10.2) == pytest.approx(0.2)


def test_a_short_gap_is_bridged_by_the_gyroscope() -> None:
    """Samples lost for 0.2 s in a turn: the rates before and after cover them."""
    source, _ = resting()
    times = [t for t in (k / RATE for k in range(2 * RATE, 4 * RATE)) if not 3.0 < t < 3.2]
    for t in times:
        source.update(about_x(0.5 * (t - 2.0)), (0.5, 0.0, 0.0), t)
    assert tilt(source, times[-1], about_x(0.5 * (times[-1] - 2.0))) < 2e-3


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
