"""The inertia tensor from motion, and the bound of the torque that is left."""

from __future__ import annotations

import contextlib
import functools
import math
from typing import Any

import numpy as np
import pytest

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ft_compensation.alignment import align
from bota_ft_compensation.identification.free_motion import identify_in_motion
from bota_ft_compensation.identification.inertia import (
    Turned,
    divided,
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
from bota_ft_compensation.turning import on_places, on_tensors
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
    found = identified(touched, tool, imu)
    assert found.payload.inertia == pytest.approx(tool.inertia, abs=5e-4)
    assert found.notes == ()
    drifted = identified(felt._replace(force=felt.force + np.array([0.5, 0.0, 0.0])), tool, imu)
    assert drifted.bias.force == pytest.approx(BIAS.force, abs=0.2), "that in the poses"
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


# -- step by step, of exact data


def turned_of(times: Array, spin: Array | float = 0.0) -> Turned:
    count = len(times)
    nothing = np.zeros((count, 3))
    return Turned(nothing, nothing, nothing, nothing + spin, np.zeros((count, 3, 3)), times)


def test_the_variance_of_pieces_is_that_of_the_answers() -> None:
    """Of residuals that are correlated, with what is known before, and of what nothing shows.

    Of 60 pieces it is some 15 % too small, as the answers take a part of their residuals.
    """
    draw, truth = np.random.default_rng([SEED, 31]), np.array((2.0, -1.0, 0.5, 3.0))
    pieces, known = np.repeat(3 * np.arange(60), 5), np.array((0.0, 0.0, 1600.0, 0.04))
    squares = []
    for _ in range(400):
        design = draw.normal(size=(180, 3, 4))[pieces] + 0.3 * draw.normal(size=(300, 3, 4))
        design[..., 3] = 0.0
        noise = draw.normal(size=(180, 3))[pieces] + 0.3 * draw.normal(size=(300, 3))
        expected = truth + np.array((0.0, 0.0, 0.025 * draw.normal(), 0.0))
        measured = design @ truth + noise * (0.05, 0.2, 1.0)
        before = np.diag(known), known * expected
        found, covariance, degrees = solve_pieces(design, measured, pieces, *before)
        assert degrees == pytest.approx(60 - 4 / 3)
        assert (found[3], covariance[3, 3]) == pytest.approx((3.0, 25.0))
        squares.append((found - truth)[:3] ** 2 / np.diag(covariance)[:3])
    assert np.mean(squares, axis=0) == pytest.approx(np.full(3, 1.15), abs=0.3)


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
    minutes, pieces, is_shown = divided(turned_of(times + 7.0, np.array([0.29, 0.31, 0.0])))
    assert pieces.tolist() == np.repeat(np.arange(20), 40).tolist()
    assert (minutes[0, 0, 0], minutes[-1, 0, 0]) == pytest.approx((-799 / 9600, 799 / 9600))
    assert (is_shown == [0, 1, 0, 1, 0, 1]).all()


@pytest.mark.parametrize(
    "chosen",
    [
        {}, {"fir": True}, {"sinc_length": 256, "fir": True}, {"sinc_length": 128}, {"sinc_length": 32},
        {"acceleration_filter": 4}, {"acceleration_filter": 8},
        {"angular_rate_filter": 5}, {"angular_rate_filter": 6, "fir": True},
    ],
)  # fmt: skip
def test_all_that_is_made_of_samples_obeys_the_equations_of_motion(chosen: dict[str, Any]) -> None:
    """Whatever the filters; also just beside gaps: all that an instant is made of is there."""
    tool, given, draw = tool_of(4), settings(**chosen), np.random.default_rng(len(chosen))
    tool = tool._replace(inertia=tuple(10.0 * each for each in tool.inertia))
    aligned = align(given, 51200 / given["sinc_length"])
    felt = motion.filtered(motion.turned(4), tool, 24.0, given, imu=motion.PERFECT)
    gaps = [
        (0.7, 0.72),
        (2.0, 2.3),
        (2.4, 2.5),
        (2.9, 4.0),
        (4.22, 4.3),
        *((at, at + 0.05) for at in range(8, 20, 3)),
    ]
    kept = np.all([(felt.times < begin) | (felt.times > end) for begin, end in gaps], axis=0)
    kept &= draw.random(len(kept)) > 0.001
    felt = Felt(*(part[kept] for part in felt))
    made = turn(felt.times, np.hstack(felt[1:]), aligned, EXACT, IMU)
    moment = tool.mass * np.array(tool.center)
    about = tensor(tool.inertia) + tool.mass * (
        np.dot(tool.center, tool.center) * np.eye(3) - np.outer(tool.center, tool.center)
    )
    elements = about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    spun = on_tensors(made.spin, made.products) @ elements
    force = made.force + tool.mass * made.felt + on_places(made.spin, made.products) @ moment
    torque = made.torque - np.cross(made.felt, moment) + spun
    assert float(np.abs(force).max()) < 2e-4 * np.std(made.force)
    assert float(np.abs(torque).max()) < 1e-3 * np.std(spun)
    period, lag = aligned.period_s, aligned.lag_s or 0.0
    taps = 22 if given["fir"] else 1
    reach, expected = period * taps + abs(lag - period * (taps - 1) / 2) + 0.05, list[float]()
    breaks = np.flatnonzero(np.diff(felt.times) > max(aligned.gap_s, 2.5 * period)) + 1
    for own in np.split(felt.times, breaks):
        if own[-1] - own[0] >= reach + 0.2:
            at = np.arange(own[0], own[-1], period)[:: max(1, round(0.0125 / period))]
            expected += at[(at > own[0] + reach) & (at < own[-1] - 0.05)].tolist()
    assert made.times.tolist() == expected
    window = np.hanning(max(3, round(0.05 / period) | 1) + 2)[1:-1]
    noise = motion.noise_like(given, (100_000, 2), SEED)
    smooth = [np.convolve(column, window / window.sum(), "valid") for column in noise.T]
    assert made.noisier == pytest.approx(1.0 / np.std(smooth), rel=0.1)
    with pytest.raises(CompensationError, match="there is a gap in every half second"):
        turn(felt.times + np.floor(felt.times / 0.2), np.hstack(felt[1:]), aligned, EXACT, IMU)


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
