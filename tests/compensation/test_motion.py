"""What is left in motion with nothing touching the tool; and where gravity points by orientations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from ft_compensation.bias import force_bound_95
from ft_compensation.compensator import Compensator
from ft_compensation.identification.weighted import Array
from ft_compensation.quantities import DEFAULT_GRAVITY, EXACT, Accelerometer, Payload
from ft_compensation.specific_force import ImuSpecificForce, QuaternionGravity
from tests.compensation import equations, motion
from tests.compensation.motion import IMU, Felt, Imperfection

TOOLS = (Payload(0.7, (0.0, 0.01, 0.04)), Payload(2.0, (0.004, -0.006, 0.08)))
SECONDS = 6.0


def left_over(felt: Felt, tool: Payload, accelerometer: Accelerometer = EXACT) -> tuple[Array, Array]:
    """Force, N, and torque, Nm, that compensation leaves, (n, 3) each; none is withheld."""
    x, y, z = (center - imu for center, imu in zip(tool.center, IMU, strict=True))
    imu, compensator = ImuSpecificForce((x, y, z), accelerometer), Compensator(tool)
    found = []
    for time_s, force, torque, acceleration, rate in zip(*(part.tolist() for part in felt), strict=True):
        specific = imu.follow((*acceleration,), (*rate,), time_s)
        assert specific is not None
        found.append(compensator.compensate((*force,), (*torque,), specific).final.values)
    both = np.array(found)
    return both[:, :3], both[:, 3:]


@pytest.mark.parametrize("tool", TOOLS, ids=["0.7 kg", "2 kg"])
@pytest.mark.parametrize("name", motion.moves(0))
def test_moves_leave_little(name: str, tool: Payload) -> None:
    """The sensor's own noise, 0.17 N, comes on top."""
    force, torque = left_over(motion.feel(motion.moves(21)[name], tool, SECONDS), tool)
    size = np.linalg.norm(force, axis=1)[1:]  # the first sample has no slope of the angular rate yet
    assert math.sqrt(float((size**2).mean())) < 0.3
    assert float(np.quantile(size, 0.99)) < 0.7
    assert float(np.linalg.norm(torque, axis=1)[1:].max()) < 1.5 * 0.1


@pytest.mark.parametrize("rate_hz", [100.0, 1600.0])
def test_at_any_rate_never_worse_than_the_bias_alone(rate_hz: float) -> None:
    tool = TOOLS[1]
    for path in motion.moves(5).values():
        felt = motion.feel(path, tool, 3.0, rate_hz)
        force, _ = left_over(felt, tool)
        alone = felt.force - felt.force.mean(axis=0)
        assert np.sqrt((force[1:] ** 2).mean()) < np.sqrt((alone[1:] ** 2).mean())


def test_the_angular_acceleration_counts() -> None:
    """A mass 0.1 m off the axis, spun up with 20 rad/s²: 4 N on 2 kg."""
    imu, spin = ImuSpecificForce((0.1, 0.0, 0.0)), 20.0
    for number in range(80):
        t = number / 800
        found = imu.follow((0.0, 0.0, STANDARD_GRAVITY), (0.0, 0.0, spin * t), t)
    assert found is not None
    assert found[1] == pytest.approx(spin * 0.1, rel=1e-3)
    assert found[0] == pytest.approx(-((spin * t) ** 2) * 0.1, rel=1e-3)


def test_a_gap_in_the_samples_is_no_slope() -> None:
    imu = ImuSpecificForce((0.1, 0.0, 0.0))
    imu.follow((0.0, 0.0, 9.8), (0.0, 0.0, 0.0), 0.0)
    for later_s in (0.5, -3.0):  # lost samples; another server's clock
        assert imu.follow((0.0, 0.0, 9.8), (0.0, 0.0, 2.0), later_s) == pytest.approx((-0.4, 0.0, 9.8))


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_numbers_that_are_none_give_no_answer_and_do_no_lasting_harm(broken: float) -> None:
    imu = ImuSpecificForce((0.0, 0.0, 0.1))
    for number, rate in enumerate((0.0, broken, 0.0, 0.0)):
        found = imu.follow((0.0, 0.0, 9.8), (rate, 0.0, 0.0), number / 800)
        assert (found is None) == (not math.isfinite(rate))
    assert found == pytest.approx((0.0, 0.0, 9.8))


def test_a_tare_takes_the_accelerometers_offset_off_in_every_pose() -> None:
    """It is a constant force in the sensor's frame, as the bias is."""
    tool, offset = Payload(2.0), (0.4, -0.3, 0.2)
    path = motion.waypoints(0.6, 1.0, 8)
    felt = motion.feel(path, tool, SECONDS, imu=Imperfection(acceleration_offset=offset))
    force, _ = left_over(felt, tool)
    tared = force - force[:400].mean(axis=0)  # half a second of rest
    assert np.linalg.norm(force, axis=1)[1:].max() > 1.0
    assert float(np.quantile(np.linalg.norm(tared, axis=1)[1:], 0.99)) < 0.7


@pytest.mark.parametrize(
    "known", [EXACT, Accelerometer(offset_interval=(0.02,) * 3, scale_interval=(0.001,) * 3)]
)
def test_the_bound_covers_the_accelerometers_errors_in_95_percent(known: Accelerometer) -> None:
    """In any pose, with an accelerometer as identification expects it, or as it has found it."""
    draw, tool = np.random.default_rng(7), Payload(1.5)
    bound, held, draws = force_bound_95(tool, known), 0, 4000
    for _ in range(draws):
        up = draw.normal(size=3)
        truth = STANDARD_GRAVITY * up / np.linalg.norm(up)
        scale = draw.normal(1.0, np.array(known.scale_interval) / 1.96)
        read = truth * scale + draw.normal(0.0, np.array(known.offset_interval) / 1.96)
        held += tool.mass * float(np.linalg.norm(read - truth)) <= bound
    assert 0.945 <= held / draws <= 0.995


G = STANDARD_GRAVITY


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


def test_which_orientation_counts_and_for_how_long() -> None:
    source = QuaternionGravity(stale_after_s=0.1)
    source.update((0.0, 0.0, 0.0, 1.0), 1.0)
    assert not source.update((1.0, 0.0, 0.0, 0.0), 0.95)
    assert source.gravity(1.0) == pytest.approx(DEFAULT_GRAVITY)
    assert source.update((1.0, 0.0, 0.0, 0.0), 0.5), "unless the clock was set back"
    source = QuaternionGravity(stale_after_s=0.25)
    source.update((0.0, 0.0, 0.0, 1.0), 10.0)
    answers = [source.gravity(now) is not None for now in (10.0, 10.25, 10.26, 1000.0, 9.7)]
    assert answers == [True, True, False, False, False]
    assert source.age_s(10.2) == pytest.approx(0.2)


# Orientations that are older or newer than the sample.


def arm(turned: float) -> tuple[float, float, float, float]:
    """The orientation of a sensor that has turned about its x axis by so much."""
    return quaternion_about((1.0, 0.0, 0.0), turned)


def test_an_orientation_is_held_where_the_gyroscope_is_of_no_use() -> None:
    source = QuaternionGravity()
    source.follow((2.0, 0.0, 0.0), 1.0)
    source.update(arm(0.0), 1.0)
    source.follow((math.nan, 0.0, 0.0), 1.01)
    assert source.gravity(1.05) == pytest.approx(DEFAULT_GRAVITY)
    for time_s in (1.02, 9.0, 1.0):  # a gap; and a clock that was set back
        source.follow((2.0, 0.0, 0.0), time_s)
    assert source.gravity(1.05) == pytest.approx(DEFAULT_GRAVITY)
