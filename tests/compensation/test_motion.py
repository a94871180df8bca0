"""What is left in motion with nothing touching the tool: on rigid-body motion, for tools of up to 2 kg."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from ft_compensation.bias import force_bound_95
from ft_compensation.compensator import Compensator
from ft_compensation.quantities import EXACT, Accelerometer, Payload
from ft_compensation.specific_force import ImuSpecificForce
from tests.compensation import motion
from tests.compensation.motion import IMU, Array, Felt, Imperfection

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


def test_an_ordinary_move_is_no_contact() -> None:
    """2 kg, 0.4 s of up to 2.5 m/s² and back: weight alone leaves 5 N."""
    tool = Payload(2.0)
    path = motion.waypoints(0.8, 0.5, 3, metres=0.5, radians=0.0)
    felt = motion.feel(path, tool, SECONDS)
    weight_only = np.linalg.norm(felt.force, axis=1) - 2.0 * STANDARD_GRAVITY
    assert np.abs(weight_only).max() > 2.0
    force, _ = left_over(felt, tool)
    assert np.linalg.norm(force, axis=1)[1:].max() < 0.4


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
