"""What has to hold on the virtual sensor with its noise; only the accelerometer tells the orientation.

At simulated time through the virtual sensor's own code; tests/bridge/test_with_server.py has the whole chain.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from ethercat_server.virtual_sensor import signals
from ethercat_server.virtual_sensor.signals import TURN_LENGTH
from ft_compensation.compensator import Compensator
from ft_compensation.identification.payload import Identified, identify
from ft_compensation.quantities import Payload, Wrench
from ft_compensation.specific_force import ImuSpecificForce
from tests.compensation.streaming import (
    OFFSET,
    POSES_TAKE,
    SINC,
    STILL,
    Stream,
    contact,
    deviations,
    samples,
    take_poses,
)

Rows = NDArray[np.float64]
TOOL = Payload(signals.TOOL_MASS, signals.TOOL_CENTRE)
SHAKEN = 128  # SINC length where the wrist sways: what compensation does not know of that is below this noise
WITHIN_3_SIGMA = 0.9973  # the share of pure noise that lies within three standard deviations


def compensated(stream: Stream, payload: Payload, bias: Wrench) -> tuple[Rows, Rows]:
    """Times (n,) and what compensation leaves (n, 6)."""
    imu, compensator = ImuSpecificForce(payload.center), Compensator(payload, bias)
    times: list[float] = []
    rows = []
    for time_s, sample in stream:
        felt = imu.follow(sample.acceleration, sample.angular_rate, time_s)
        if felt is None:  # the first: how fast it spins up is not known
            assert not times
            continue
        times.append(time_s)
        rows.append(compensator.compensate(sample.force, sample.torque, felt).final.values)
    return np.array(times), np.array(rows)


def within_three_sigma(left: Rows, sinc: int = SINC) -> Rows:
    """The share of samples within three standard deviations of the sensor's noise, (6,)."""
    share: Rows = (np.abs(left) <= 3.0 * np.array(deviations(sinc))).mean(axis=0)
    return share


def truth(times: Rows) -> Rows:
    """What the tool of `scene` is touched with, (n, 6)."""
    return np.array([contact(float(time_s)) for time_s in times])


def smooth(left: Rows, count: int = 40) -> Rows:
    """Means over 400 ms, which show what is not noise."""
    whole = len(left) // count * count
    means: Rows = left[:whole].reshape(-1, count, 6).mean(axis=1)
    return means


@pytest.fixture(scope="module")
def identified() -> Identified:
    return identify(take_poses(samples("poses", POSES_TAKE, part=STILL)))


@pytest.fixture(scope="module")
def touched() -> Stream:
    """Three contacts."""
    return list(samples("scene", 20.0, seed=4, sinc=SHAKEN))


@pytest.mark.parametrize(("seed", "sinc"), [(0, SINC), (1, 51)])
def test_six_poses_give_mass_within_1_percent_and_center_within_2_mm(seed: int, sinc: int) -> None:
    found = identify(take_poses(samples("poses", POSES_TAKE, seed, sinc, STILL)))
    assert found.coverage.poses >= 6
    assert found.payload.mass == pytest.approx(TOOL.mass, rel=0.01)
    assert math.dist(found.payload.center, TOOL.center) < 0.002
    assert found.bias.force == pytest.approx(OFFSET[:3], abs=0.1)
    assert found.bias.torque == pytest.approx(OFFSET[3:], abs=0.002)
    assert abs(found.payload.mass - TOOL.mass) < 3 * found.mass_interval
    assert found.notes == ()


def test_through_a_slow_full_turn_only_noise_is_left(identified: Identified) -> None:
    _, left = compensated(samples("turn", TURN_LENGTH, seed=3), identified.payload, identified.bias)
    sigma = np.array(deviations())
    # What is left of the noise in a mean of 40, and a fifth of its standard deviation for everything else.
    assert (np.abs(smooth(left)) <= 4.0 * sigma / 40**0.5 + 0.2 * sigma).all()
    # The accelerometer's noise on this tool comes on top.
    assert within_three_sigma(left).min() > WITHIN_3_SIGMA - 0.03


def test_contacts_of_the_scene_show_up_undistorted(identified: Identified, touched: Stream) -> None:
    times, left = compensated(touched, identified.payload, identified.bias)
    touch = truth(times)
    error = left - touch
    assert within_three_sigma(error, SHAKEN).min() > WITHIN_3_SIGMA - 0.004
    touching = np.abs(touch[:, 2]) > 1.0
    assert touching.sum() > 300
    for axis in (0, 1, 2, 3, 4):
        real = touch[touching, axis]
        scale = float(left[touching, axis] @ real / (real @ real))
        assert scale == pytest.approx(1.0, abs=0.05), f"axis {axis} is scaled by {scale:.3f}"
