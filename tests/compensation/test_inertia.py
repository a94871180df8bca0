"""The inertia tensor from motion, and the bound of the torque that is left."""

from __future__ import annotations

import contextlib
import functools
import math
import random
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.alignment import align
from bota_ft_compensation.bias import TareBasis
from bota_ft_compensation.bounds import (
    IMU_BELOW,
    force_bound_95,
    inertia_noise,
    torque_bound_95,
    torque_noise_95,
)
from bota_ft_compensation.identification.inertia import (
    Turned,
    divided,
    identify_inertia,
    possible_inertia,
    solve_pieces,
    turn,
    untouched,
)
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


def identified(
    felt: Felt, tool: Payload, known: Accelerometer = EXACT, off_m: float = 0.0, **chosen: Any
) -> Identified:
    """By poses that have the center of gravity wrong by `off_m`, each way."""
    noise = random.Random(int(1e6 * tool.mass))
    poses = identify([pose(up, tool, BIAS, noise, 0.0005 if off_m else 0.01) for up in AXES])
    x, y, z = poses.payload.center
    poses = poses._replace(payload=poses.payload._replace(center=(x + off_m, y - off_m, z + off_m)))
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


def test_in_motion_the_center_of_gravity_is_not_quite_that_of_the_poses() -> None:
    tool = tool_of(6)
    found = identified(recorded("turned", 6, tool), tool, imperfect(6).known, 2e-4).payload
    assert np.all(np.abs(np.subtract(found.inertia, tool.inertia)) < found.inertia_interval)


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


# -- step by step, of exact data


def turned_of(times: Array, spun: Array | float = 0.0) -> Turned:
    count = len(times)
    nothing = np.zeros((count, 3))
    return Turned(nothing, nothing, nothing, np.zeros((count, 3, 3)), np.zeros((count, 3, 6)) + spun, times)


def test_the_variance_of_pieces_is_that_of_the_answers() -> None:
    """Of residuals that are correlated, with what is known before, and of what nothing shows."""
    draw, truth = np.random.default_rng([SEED, 31]), np.array((2.0, -1.0, 0.5, 3.0))
    pieces, known = np.repeat(3 * np.arange(60), 5), np.array((0.0, 0.0, 1600.0, 0.04))
    squares = []
    for _ in range(400):
        design = draw.normal(size=(180, 3, 4))[pieces] + 0.3 * draw.normal(size=(300, 3, 4))
        design[..., 3] = 0.0
        noise = draw.normal(size=(180, 3))[pieces] + 0.3 * draw.normal(size=(300, 3))
        expected = truth + np.array((0.0, 0.0, 0.025 * draw.normal(), 0.0))
        measured = design @ truth + noise * (0.05, 0.2, 1.0)
        found, covariance, degrees = solve_pieces(design, measured, pieces, known, expected)
        assert degrees == pytest.approx(60 - 4 / 3)
        assert (found[3], covariance[3, 3]) == pytest.approx((3.0, 25.0))
        squares.append((found - truth)[:3] ** 2 / np.diag(covariance)[:3])
    assert np.mean(squares, axis=0) == pytest.approx(np.ones(3), abs=0.25)


def test_the_nearest_tensor_of_a_body_within_the_interval() -> None:
    turn_by = motion.rotations(np.array([[0.3, -0.5, 0.8]]))[0]

    def turned(*moments: float) -> tuple[float, ...]:
        return tuple(
            (turn_by @ np.diag(moments) @ turn_by.T)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
        )

    impossible, nearest = turned(0.01, 0.02, 0.035), turned(0.0125, 0.0225, 0.035)
    for half, given, expected in (
        (1e-9, turned(0.01, 0.02, 0.025), turned(0.01, 0.02, 0.025)),
        (0.0026, impossible, nearest),
        (0.0024, impossible, None),
    ):
        interval = half * np.array((0.6, 0.0, 0.0, 0.0, 0.8, 0.0))
        with (
            contextlib.nullcontext()
            if expected
            else pytest.raises(
                CompensationError, match=r"moments of inertia would be 0\.01, 0\.02, 0\.035 kg m²"
            )
        ):
            assert possible_inertia(np.array(given), interval) == pytest.approx(expected)


def test_a_touch_is_left_out_with_what_is_near_and_hardly_any_turning_is_noise() -> None:
    times = np.linspace(0.0, 9.9875, 800)
    beyond = np.zeros(800)
    beyond[400], beyond[100] = 2.01, 1.99
    assert np.flatnonzero(~untouched(turned_of(times), beyond, 20.0)).tolist() == [*range(384, 417)]
    spun = np.array((0.0, 0.29, 0.31, 5.0, 0.0, 0.0)) / math.sqrt(3) * np.ones((3, 1))
    minutes, pieces, kept = divided(turned_of(times + 7.0, spun))
    assert pieces.tolist() == np.repeat(np.arange(20), 40).tolist()
    assert (minutes[0, 0, 0], minutes[-1, 0, 0]) == pytest.approx((-799 / 9600, 799 / 9600))
    assert kept == pytest.approx(np.broadcast_to(spun * [0, 0, 1, 1, 0, 0], (800, 3, 6)))


@pytest.mark.parametrize(
    ("rate", "acceleration", "refused"),
    [
        *((1 / gain, 1.0, abs(gain - 1) > 0.35) for gain in (0.6, 0.68, 1.32, 1.4)),
        *((1.0, size / STANDARD_GRAVITY, not 7 < size < 13) for size in (6.7, 7.3, 12.7, 13.3)),
    ],
)
def test_from_which_disagreement_on_an_imu_is_refused(
    rate: float, acceleration: float, refused: bool
) -> None:
    """Of a sensor that turns about its IMU, which feels gravity only."""

    def angles(t: Array) -> Array:
        return np.stack([np.sin(2 * t), 0.5 * np.sin(3 * t), 0.7 * np.cos(2.5 * t)], axis=1)

    felt = motion.feel(lambda t: (np.zeros((len(t), 3)), angles(t)), tool_of(1), 6.0, imu=motion.PERFECT)
    rotation = motion.rotations(angles(felt.times))
    gravity = STANDARD_GRAVITY * acceleration * rotation[:, 2]
    samples = np.hstack([felt.force, felt.torque, gravity, rate * felt.rate])
    with pytest.raises(CompensationError) if refused else contextlib.nullcontext():
        turn(felt.times, samples, align(settings(), RATE_HZ), EXACT, (0.0, 0.0, 0.0))


def test_each_part_of_the_bounds_alone() -> None:
    tool, typical = Payload(2.0, (0.03, 0.0, -0.04), (0.0,) * 6, (1e-12,) * 3, (1e-12,) * 6), 2.80 / 1.96
    none = EXACT._replace(
        offset_interval=(0.0,) * 3, scale_interval=(0.0,) * 3, cross_axis_interval=(0.0,) * 6
    )
    for name, count, unit in (
        ("offset_interval", 3, 1.0),
        ("scale_interval", 3, STANDARD_GRAVITY),
        ("cross_axis_interval", 6, STANDARD_GRAVITY),
    ):
        for axis in range(count):
            known = none._replace(**{name: tuple(0.01 * np.eye(count)[axis])})
            assert force_bound_95(tool, known) == pytest.approx(2.0 * typical * 0.01 * unit)
            assert torque_bound_95(tool, known) == pytest.approx(2.0 * typical * 0.01 * unit * 0.05)
            taken = TareBasis(tool, (1.0, 0.0, 0.0), known)
            tared = 4.39 / 1.96 * 0.01 * unit * (name != "offset_interval")
            assert force_bound_95(tool, known, taken) == pytest.approx(2.0 * tared)
            assert force_bound_95(tool, known, TareBasis(tool, (1.0, 0.0, 0.0), none)) > 1.9 * typical * 0.01
    vector, felt, still = (3.0, -4.0, 12.0), (2.0, 1.0, -2.0), (0.0, 0.0, 0.0)
    for element, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        one = tool._replace(inertia_interval=tuple(0.01 * np.eye(6)[element]))
        expected = 0.01 * (math.hypot(vector[i], vector[j]) if i != j else abs(vector[i]))
        assert torque_bound_95(one, none, turning=(still, vector)) == pytest.approx(expected)
        assert torque_bound_95(one, none, turning=(vector, still)) == pytest.approx(0.5 * 13.0 * expected)
    vague = tool._replace(center_interval=(0.001, 0.003, 0.002))
    assert torque_bound_95(vague, none, felt=felt) == pytest.approx(2.0 * typical * 0.003 * 3.0)
    taken = TareBasis(tool, (1.0, 0.0, 0.0), none)
    assert torque_bound_95(vague, none, taken, felt) == pytest.approx(2.0 * 4.39 / 1.96 * 0.003 * 3.0)
    assert torque_bound_95(tool, none, noise=0.02) == pytest.approx(0.02)
