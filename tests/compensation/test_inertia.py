"""The inertia tensor from motion, and the bound of the torque that is left."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.alignment import align
from bota_ft_compensation.identification.free_motion import identify_in_motion
from bota_ft_compensation.identification.inertia import turn
from bota_ft_compensation.identification.payload import Identified, identify
from bota_ft_compensation.quantities import (
    EXACT,
    Accelerometer,
    CompensationError,
    Payload,
    likely_inertia,
)
from tests.compensation import motion
from tests.compensation.coverage import Case, poses_of
from tests.compensation.making import BIAS, SEED
from tests.compensation.motion import (
    IMU,
    Array,
    Felt,
    Imperfection,
    Left,
    Path,
    imperfect,
    left_over,
    settings,
    tensor,
    tool_of,
)
from tests.simulation import more_if_long

RATE_HZ = 800.0
FORCE_NOISE, TORQUE_NOISE = 0.17 / math.sqrt(3), (0.0059, 0.0059, 0.0021)  # a healthy sensor's, SINC 64


def path_of(name: str, seed: int) -> Path:
    if name in motion.moves(seed):
        return motion.moves(seed)[name]
    turned = motion.turned(seed)
    kept: Any = {"turned": 1.0, "about x": (0.0, 0.0, 1.0), "still": 1e-4}[name]
    return lambda t: (0.0 * turned(t)[0], turned(t)[1] * kept)


@functools.cache
def recorded(name: str, seed: int, tool: Payload, seconds: float = 20.0, **chosen: Any) -> Felt:
    """With the sensor's noise and bias, at these settings."""
    felt = motion.filtered(
        path_of(name, seed), tool, seconds, settings(**chosen), seed=seed, imu=imperfect(seed)
    )
    draw, shape = np.random.default_rng([seed, 4]), felt.force.shape
    return felt._replace(
        force=felt.force + BIAS.force + draw.normal(0.0, FORCE_NOISE, shape),
        torque=felt.torque + BIAS.torque + draw.normal(0.0, TORQUE_NOISE, shape),
    )


def identified(felt: Felt, tool: Payload, imu: Imperfection, **chosen: Any) -> Identified:
    poses = identify(poses_of(tool, Case(), imu, int(1e6 * tool.mass)))
    alignment = align(settings(**chosen), RATE_HZ)
    return identify_in_motion(turn(felt.times, np.hstack(felt[1:]), alignment, EXACT, IMU), IMU, poses)


def left(felt: Felt, tool: Payload, known: Accelerometer) -> Left:
    """After the first second."""
    return left_over(felt, tool, align(settings(), RATE_HZ), known, settling_s=1.0, bias=BIAS)


def rms(torque: Array) -> float:
    return math.sqrt(float((torque**2).sum(axis=1).mean()))


FILTERS: dict[str, dict[str, Any]] = {
    "as delivered": {},
    "FIR on": {"fir": True},
    "a slow gyroscope": {"angular_rate_filter": 6},
    "a slow accelerometer": {"acceleration_filter": 4, "angular_rate_filter": 9},
}


@pytest.mark.parametrize("filters", FILTERS)
@pytest.mark.parametrize("seed", more_if_long([0, 1], range(12)))
def test_in_20_s_of_motion_every_principal_moment_is_found_to_10_percent(seed: int, filters: str) -> None:
    seed += 1000 * SEED
    tool, imu, chosen = tool_of(seed), imperfect(seed), FILTERS[filters]
    felt = recorded("turned", seed, tool, **chosen)
    found = identified(felt, tool, imu, **chosen)
    moments, truth = (np.linalg.eigvalsh(tensor(each.inertia)) for each in (found.payload, tool))
    assert np.abs(moments / truth - 1.0).max() < 0.1
    assert max(found.payload.inertia_interval) < 0.1 * truth[2]
    if not chosen:
        assert rms(left(felt, found.payload, imu.known).torque) < 0.03


def test_where_it_hardly_turns_only_what_mass_and_center_make_likely_is_known() -> None:
    tool, imu = tool_of(5), imperfect(5)
    with pytest.raises(CompensationError, match="hardly turned about x and y and z"):
        identified(recorded("still", 5, tool, 8.0), tool, imu)
    about_x = identified(recorded("about x", 5, tool, 8.0), tool, imu)
    half = likely_inertia(about_x.payload)[1]
    assert "hardly turned about y and z" in about_x.notes[0]
    assert about_x.payload.inertia[0] == pytest.approx(tool.inertia[0], rel=0.1)
    assert about_x.payload.inertia_interval[0] < 0.1 * half[0]
    assert about_x.payload.inertia_interval[2] == pytest.approx(half[2], rel=0.2)


def test_samples_with_contact_are_left_out_and_what_no_body_has_is_refused() -> None:
    tool, imu = tool_of(6), imperfect(6)
    felt = recorded("turned", 6, tool)
    pushed = (felt.times[:, None] % 5.0 < 1.5) * np.array([4.0, -2.0, 1.0])
    touched = felt._replace(force=felt.force + pushed, torque=felt.torque + np.cross([0.0, 0.1, 0.1], pushed))
    assert identified(touched, tool, imu).payload.inertia == pytest.approx(tool.inertia, abs=5e-4)
    with pytest.raises(CompensationError, match="touched the tool all the time"):
        identified(felt._replace(force=felt.force + np.array([4.0, 0.0, 0.0])), tool, imu)
    for factor, told in ((-1.0, "-1.0"), (np.degrees(1.0), "0.01"), (np.radians(1.0), "6")):
        with pytest.raises(CompensationError, match=f"gravity turns {told}.* times as fast"):
            identified(felt._replace(rate=factor * felt.rate), tool, imu)
    with pytest.raises(CompensationError, match=r"accelerometer reads [012]\.\d+ m/s²"):
        identified(felt._replace(acceleration=felt.acceleration / STANDARD_GRAVITY), tool, imu)
    spun = np.gradient(felt.rate, 1.0 / RATE_HZ, axis=0)
    with pytest.raises(CompensationError, match=r"which no body has|moves freely"):
        identified(felt._replace(torque=felt.torque + spun @ np.diag([0.1, 0.0, 0.0])), tool, imu)
    lost = np.abs(felt.times % 3.0 - 1.0) > 0.2
    assert identified(Felt(*(part[lost] for part in felt)), tool, imu).payload.inertia == pytest.approx(
        tool.inertia, abs=5e-4
    )
