"""The inertia tensor from motion, and the bound of the torque that is left."""

from __future__ import annotations

import functools
import math
import random
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.alignment import align
from bota_ft_compensation.bounds import (
    IMU_BELOW,
    inertia_noise,
    torque_bound_95,
    torque_noise_95,
)
from bota_ft_compensation.identification.inertia import identify_inertia, turn
from bota_ft_compensation.identification.payload import Identified, identify
from bota_ft_compensation.quantities import (
    EXACT,
    Accelerometer,
    CompensationError,
    Payload,
    likely_inertia,
)
from tests.compensation import motion
from tests.compensation.making import AXES, BIAS, SEED, pose
from tests.compensation.motion import IMU, Array, Felt, Left, Path, imperfect, left_over, settings, tensor
from tests.simulation import more_if_long

RATE_HZ = 800.0
FORCE_NOISE, TORQUE_NOISE = 0.17 / math.sqrt(3), (0.0059, 0.0059, 0.0021)  # a healthy sensor's, SINC 64


def tool_of(seed: int, mass: float = 1.5) -> Payload:
    """Eight lumps in a box of 8 to 24 cm, somewhere before the sensor."""
    draw = np.random.default_rng([seed, 3])
    at, lumps = draw.uniform(0.0, 2.0 * np.pi), draw.dirichlet(np.full(8, 3.0)) * mass
    places = draw.uniform(-1.0, 1.0, size=(8, 3)) * draw.uniform(0.04, 0.12, size=3)
    places -= lumps @ places / mass
    second = (places.T * lumps) @ places
    j = np.trace(second) * np.eye(3) - second
    center = 0.06 * math.cos(at), 0.06 * math.sin(at), draw.uniform(0.02, 0.05)
    return Payload(mass, center, (j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2]))


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


def identified(felt: Felt, tool: Payload, known: Accelerometer = EXACT, **chosen: Any) -> Identified:
    noise = random.Random(int(1e6 * tool.mass))
    poses = identify([pose(up, tool, BIAS, noise, 0.01) for up in AXES])
    alignment = align(settings(**chosen), RATE_HZ)
    return identify_inertia(turn(felt.times, np.hstack(felt[1:]), alignment, known, IMU), poses)


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
    tool, known, chosen = tool_of(seed), imperfect(seed).known, FILTERS[filters]
    felt = recorded("turned", seed, tool, **chosen)
    found = identified(felt, tool, known, **chosen)
    moments, truth = (np.linalg.eigvalsh(tensor(each.inertia)) for each in (found.payload, tool))
    assert np.abs(moments / truth - 1.0).max() < 0.1
    assert max(found.payload.inertia_interval) < 0.1 * truth[2]
    if not chosen:
        assert rms(left(felt, found.payload, known).torque) < 0.03


@pytest.mark.parametrize("count", more_if_long([12], [12, 60]))
def test_its_intervals_cover_95_percent(count: int) -> None:
    held = []
    for seed in range(1000 * SEED, 1000 * SEED + count):
        tool = tool_of(seed, mass=0.5 + 0.1 * (seed % 20))
        felt = recorded("turned", seed, tool, 6.0)
        found = identified(felt, tool, imperfect(seed).known)
        held += (
            np.abs(np.subtract(found.payload.inertia, tool.inertia)) <= found.payload.inertia_interval
        ).tolist()
    assert np.mean(held) > 0.9


RMS_OF_95 = math.sqrt(3) / 2.80  # of three axes alike


@pytest.mark.parametrize("seed", more_if_long([3], range(3, 9)))
@pytest.mark.parametrize("name", ["turned", "pick and place", "hand-guiding", "mobile base"])
def test_the_bound_covers_95_percent_of_the_torque_that_is_left(name: str, seed: int) -> None:
    """Of a tool of unknown inertia, off the axis; identified, its bound is hardly more than at rest."""
    seed += 1000 * SEED
    tool, known = tool_of(seed), imperfect(seed).known
    felt, found = recorded(name, seed, tool, 6.0), identified(recorded("turned", seed, tool), tool, known)
    for each in (tool._replace(inertia=(0.0,) * 6), found.payload):
        _, _, torque, turnings, felts = left(felt, each, known)
        noise = torque_noise_95(each, align(settings(), RATE_HZ))
        bounds = np.array([
            torque_bound_95(each, known, None, specific, turning, noise)
            for specific, turning in zip(felts, turnings, strict=True)
        ])  # fmt: skip
        assert (np.linalg.norm(torque, axis=1) <= bounds).mean() > 0.95
        at_rest = torque_bound_95(each, known, None, noise=noise)
        assert np.median(bounds) < (1.2 * at_rest if each is found.payload else 0.9)
    assert rms(torque) < (0.03 if name == "turned" else max(0.015, RMS_OF_95 * noise))


@pytest.mark.parametrize("what", ["rate", "spin"])
def test_the_bound_of_an_unknown_inertia_alone_is_neither_narrow_nor_wide(what: str) -> None:
    draw, half = np.random.default_rng([SEED, 12]), np.array((1e-3, 2e-3, 1.5e-3, 8e-4, 5e-4, 6e-4))
    tool, known = (
        Payload(1.0, (0.0, 0.0, 0.0), (0.01,) * 6, inertia_interval=tuple(half)),
        EXACT._replace(offset_interval=(0.0,) * 3, scale_interval=(0.0,) * 3, cross_axis_interval=(0.0,) * 6),
    )
    shares = []
    for _ in range(1000):
        wrong, turned = tensor(tuple(draw.normal(size=6) * half / 1.96)), draw.normal(size=3)
        torque = wrong @ turned if what == "spin" else np.cross(turned, wrong @ turned)
        still, (x, y, z) = (0.0, 0.0, 0.0), turned.tolist()
        turning = (still, (x, y, z)) if what == "spin" else ((x, y, z), still)
        shares.append(np.linalg.norm(torque) / torque_bound_95(tool, known, None, still, turning))
    assert 0.85 < np.mean(np.array(shares) <= 1.0) < 0.99
    assert np.mean(shares) > 0.4


def test_the_noise_of_the_gyroscope_acts_on_lever_and_tensor_together() -> None:
    alignment, tool = align(settings(), RATE_HZ), Payload(2.0, (0.0, 0.0, 0.1), (0.02, 0.01, 0.005, 0, 0, 0))
    spin, lever = alignment.noise()[1], 2.0 * 0.1 * (0.1 + IMU_BELOW)
    both = math.hypot(spin * lever, inertia_noise(tool, alignment))
    assert both == pytest.approx(spin * (lever + 0.02))


def test_where_it_hardly_turns_only_what_mass_and_center_make_likely_is_known() -> None:
    tool, known = tool_of(5), imperfect(5).known
    still, about_x = (identified(recorded(name, 5, tool, 8.0), tool, known) for name in ("still", "about x"))
    likely, half = likely_inertia(still.payload)
    assert "hardly turned about x and y and z" in still.notes[0]
    assert still.payload.inertia == pytest.approx(likely, abs=0.1 * half[0])
    assert still.payload.inertia_interval == pytest.approx(half, rel=0.2)
    assert "hardly turned about y and z" in about_x.notes[0]
    assert about_x.payload.inertia[0] == pytest.approx(tool.inertia[0], rel=0.1)
    assert about_x.payload.inertia_interval[0] < 0.05 * half[0]


def test_samples_with_contact_are_left_out_and_what_no_body_has_is_refused() -> None:
    tool, known = tool_of(6), imperfect(6).known
    felt = recorded("turned", 6, tool)
    pushed = (felt.times[:, None] % 5.0 < 1.5) * np.array([4.0, -2.0, 1.0])
    touched = felt._replace(force=felt.force + pushed, torque=felt.torque + np.cross([0.0, 0.1, 0.1], pushed))
    assert identified(touched, tool, known).payload.inertia == pytest.approx(tool.inertia, abs=5e-4)
    with pytest.raises(CompensationError, match="touched the tool all the time"):
        identified(felt._replace(force=felt.force + np.array([4.0, 0.0, 0.0])), tool, known)
    for factor, told in ((-1.0, "-0.9"), (np.degrees(1.0), "0.01"), (np.radians(1.0), "5")):
        with pytest.raises(CompensationError, match=f"gravity turns {told}.* times as fast"):
            identified(felt._replace(rate=factor * felt.rate), tool, known)
    with pytest.raises(CompensationError, match=r"accelerometer reads [12]\.\d+ m/s²"):
        identified(felt._replace(acceleration=felt.acceleration / STANDARD_GRAVITY), tool, known)
    spun = np.gradient(felt.rate, 1.0 / RATE_HZ, axis=0)
    with pytest.raises(CompensationError, match=r"would be .* kg m², which no body has"):
        identified(felt._replace(torque=felt.torque + spun @ np.diag([0.1, 0.0, 0.0])), tool, known)
    lost = np.abs(felt.times % 3.0 - 1.0) > 0.2
    assert identified(Felt(*(part[lost] for part in felt)), tool, known).payload.inertia == pytest.approx(
        tool.inertia, abs=5e-4
    )
