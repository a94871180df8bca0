"""The lag between force and accelerometer, found from a recording of a sensor that was shaken by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from bota_ethercat.sensor.response import acceleration_response, force_lag_s, force_torque_response
from bota_ft_compensation.alignment import gyroscope_later_s
from bota_ft_compensation.identification.delay import Lag, check_held_out, find_lag, lowest
from bota_ft_compensation.identification.resampling import resampled
from bota_ft_compensation.quantities import CompensationError, Payload
from tests.compensation import motion
from tests.compensation.making import SEED
from tests.compensation.motion import Felt, Imperfection, settings
from tests.simulation import more_if_long

TOOL = Payload(0.7, (0.0, 0.01, 0.04))
GYROSCOPE_S = 0.0029 - 0.00194


def shaken(seed: int) -> motion.Path:
    return motion.guided(seed, metres=0.06, radians=0.3, hertz=(1.5, 4.0))


def lag_of(felt: Felt, gyroscope_s: float = GYROSCOPE_S) -> Lag:
    force = felt.force + np.random.default_rng(5).normal(0, 0.3, felt.force.shape)
    return find_lag(felt.times, force, felt.acceleration, felt.rate, gyroscope_s)


@pytest.mark.parametrize("filters", [(1, 6), (4, 9)])
def test_how_late_the_gyroscope_is_does_not_matter(filters: tuple[int, int]) -> None:
    """Of a tool that mostly turns."""
    acceleration, rate = filters
    chosen = settings(acceleration_filter=acceleration, angular_rate_filter=rate)
    path, tool = motion.turned(SEED + 1), Payload(1.5, (0.05, 0.0, 0.12))
    found = lag_of(motion.filtered(path, tool, 10.0, chosen), gyroscope_later_s(chosen))
    assert found.seconds == pytest.approx(force_lag_s(chosen), abs=3e-4)
    assert found.explained > 0.99


@pytest.mark.parametrize(
    ("sinc_length", "fir"),
    more_if_long(
        [(64, True), (512, False)], [(32, False), (64, False), (64, True), (512, False), (512, True)]
    ),
)
@pytest.mark.parametrize("seed", more_if_long([1], range(1, 6)))
def test_the_lag_is_found(sinc_length: int, fir: bool, seed: int) -> None:
    chosen, seed = settings(sinc_length, fir), seed + 1000 * SEED
    truth = (force_torque_response(chosen).delay_s or 0) - (acceleration_response(chosen).delay_s or 0)
    found = lag_of(motion.filtered(shaken(seed), TOOL, 10.0, chosen, seed=seed))
    assert found.seconds == pytest.approx(truth, abs=max(2 * found.interval_s, 2e-4))
    assert found.interval_s < 2e-3
    assert found.explained > 0.95


@pytest.mark.parametrize("seed", more_if_long([2], range(2, 6)))
@pytest.mark.parametrize("sinc_length", [32, 128, 512])
def test_a_lag_is_tried_on_parts_that_did_not_choose_it(sinc_length: int, seed: int) -> None:
    """A lag that makes it worse is refused, as one that looks ahead by an IMU that is too noisy for that."""
    chosen, seed = settings(sinc_length), seed + 1000 * SEED
    felt = motion.filtered(shaken(seed), TOOL, 10.0, chosen, seed=seed)
    noise = np.random.default_rng(seed)
    samples = np.hstack([felt.force + noise.normal(0, 0.1, felt.force.shape), felt.acceleration, felt.rate])
    found = lag_of(felt)
    aligned, not_aligned = check_held_out(felt.times, samples, chosen, found)
    assert aligned < 0.95 * not_aligned
    with pytest.raises(CompensationError, match="do not use it"):
        check_held_out(felt.times, samples, chosen, found._replace(seconds=found.seconds + 0.05))
    samples[:, 3:6] += noise.normal(0, 3.0, felt.force.shape)
    with pytest.raises(CompensationError, match="do not use it"):
        check_held_out(felt.times, samples, chosen, found._replace(seconds=-0.012))


def test_motion_that_does_not_tell_the_force_elsewhere_is_refused() -> None:
    """Whatever lag fits best: of two poses 630 N were left in the other parts, and it was a result."""
    felt = motion.filtered(shaken(1), TOOL, 10.0, settings())
    pulled = np.random.default_rng(SEED).normal(0.0, 0.5, felt.force.shape).cumsum(axis=0)
    samples = np.concatenate([felt.force + pulled, felt.acceleration, felt.rate], axis=1)
    with pytest.raises(CompensationError, match="does not tell the force in the others"):
        check_held_out(felt.times, samples, settings(), Lag(0.0, 1e-4, 0.999))


def other_make(path: motion.Path, rate_hz: float, lag_s: float, seed: int) -> Lag:
    """A sensor with axes of its own, gains 2 % off, a drift of 1 N, and stamps that jitter by 0.5 ms."""
    draw = np.random.default_rng(seed)
    imu = Imperfection(0.05, 0.003, 0.02, (0.2, -0.1, 0.3), (1.01, 0.99, 1.0))
    felt = motion.feel(path, TOOL, 20.0, rate_hz, seed=seed, imu=imu)
    force = motion.feel(motion.later(path, lag_s), TOOL, 20.0, rate_hz, imu=motion.PERFECT).force
    axes = np.linalg.qr(draw.normal(size=(3, 3)))[0] * draw.normal(1.0, 0.02, size=3)
    drift = np.linspace(0.0, 1.0, len(force))[:, np.newaxis] + (5.0, -3.0, 8.0)
    force = force @ axes + drift + draw.normal(0.0, 0.3, force.shape)
    stamps = np.sort(felt.times + draw.normal(0.0, 5e-4, len(force))) + 1e-9 * np.arange(len(force))
    return find_lag(stamps, force, felt.acceleration, felt.rate)


PATHS: dict[str, Callable[[int], motion.Path]] = {
    "shaken": shaken,
    "fast": lambda seed: motion.waypoints(0.4, 0.1, seed),
    "slow": motion.guided,
}


@pytest.mark.parametrize(
    ("path", "rate_hz"),
    more_if_long(
        [("shaken", 800.0), ("fast", 100.0), ("slow", 100.0)], itertools.product(PATHS, (100.0, 250.0, 800.0))
    ),
)
@pytest.mark.parametrize("seed", more_if_long([1], range(1, 6)))
def test_the_lag_of_another_make_of_sensor_is_found(path: str, rate_hz: float, seed: int) -> None:
    seed += 1000 * SEED
    found = other_make(PATHS[path](seed), rate_hz, 0.0084, seed)
    assert found.seconds == pytest.approx(0.0084, abs=min(2 * found.interval_s, 2e-3))


@pytest.mark.parametrize(
    ("path", "tool", "seconds", "why"),
    [
        (shaken(1), TOOL, 2.0, "too few"),
        (shaken(1), Payload(0.001), 5.0, "explains only"),
        (motion.guided(1, hertz=(0.02, 0.05)), TOOL, 10.0, "too slow"),
    ],
    ids=["short", "no tool", "slow"],
)
def test_what_shows_nothing_is_refused(path: motion.Path, tool: Payload, seconds: float, why: str) -> None:
    felt = motion.filtered(path, tool, seconds, settings())
    with pytest.raises(CompensationError, match=why):
        lag_of(felt)


def test_samples_of_two_servers_are_refused() -> None:
    felt = motion.filtered(shaken(1), TOOL, 5.0, settings())
    with pytest.raises(CompensationError, match="order of their times"):
        lag_of(felt._replace(times=np.where(felt.times < 2.5, felt.times, felt.times - 1.0)))


def test_a_stretch_that_is_long_enough_is_used() -> None:
    times = np.concatenate([np.arange(0.0, 0.9, 0.01), np.arange(2.0, 3.5, 0.01)])
    period, parts = resampled(times, times[:, None], 1.0)
    assert period == pytest.approx(0.01)
    assert [(round(grid[0], 2), round(grid[-1], 1)) for grid, _ in parts] == [(2.0, 3.5)]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_minimum_is_found_near_where_the_search_begins_and_no_maximum(side: float) -> None:
    assert lowest(lambda x: (x - 0.7 * side) ** 2 + 0.1 * side * x**3, 0.5 * side, 0.1) == pytest.approx(
        side * (math.sqrt(4 + 4 * 0.3 * 1.4) - 2) / 0.6, abs=1e-4
    )
    steps = sum(0.5**n for n in range(6))
    assert lowest(lambda x: (x - 100.0 * side) ** 2, 0.0, 1.0) == pytest.approx(side * steps)
    assert lowest(lambda x: -((x - side) ** 2), 0.0, 1.0) == 0.0


@pytest.mark.parametrize("feature", range(9))
def test_a_force_of_one_part_of_the_motion_alone_is_explained(feature: int) -> None:
    """Specific force, or a product of rates, as they come."""
    draw = np.random.default_rng([SEED, 8]).normal(size=(8000, 6))
    imu = np.stack([np.convolve(column, np.hanning(80) / 10, "same") for column in draw.T], axis=1)
    acceleration, (x, y, z) = imu[:, :3], imu[:, 3:].T
    part = [*acceleration.T, x * x, x * y, x * z, y * y, y * z, z * z][feature]
    samples = np.concatenate([part[:, np.newaxis] * [1.0, -2.0, 3.0], imu], axis=1)
    with pytest.raises(CompensationError, match=r"leaves .* N in .* and (0\.00\d+|\d\.?\d*e-\d+) N without"):
        check_held_out(np.arange(8000) / 800.0, samples, {}, Lag(0.01, 1e-4, 1.0))


def test_a_lag_that_changes_has_a_wide_interval() -> None:
    """As of a cable that pulls: by 2 ms to and fro, from part to part."""
    felt = motion.filtered(shaken(1), TOOL, 10.0, settings(), seed=1)
    shifted = felt.times - 0.002 * np.sin(0.2 * np.pi * felt.times)
    force = np.stack([np.interp(shifted, felt.times, axis) for axis in felt.force.T], axis=1)
    assert 0.8e-3 < lag_of(felt._replace(force=force)).interval_s < 2e-3


def test_what_is_left_of_a_part_is_by_the_tool_of_the_other_parts() -> None:
    """One eighth is of a tool that is twice as heavy."""
    draw = np.random.default_rng([SEED, 9]).normal(size=(8000, 6))
    imu = np.stack([np.convolve(column, np.hanning(160) / 10, "same") for column in draw.T], axis=1)
    force = imu[:, :3] * np.where(np.arange(8000) < 1000, 2.0, 1.0)[:, np.newaxis]
    samples = np.concatenate([force, imu], axis=1)
    _, left = check_held_out(np.arange(8000) / 800.0, samples, {}, Lag(0.0, 1e-4, 1.0))
    parts = (imu[:, :3] ** 2).sum(axis=1).reshape(8, -1).sum(axis=1)
    mass_error = np.append(
        1.0, parts[0] / (parts.sum() - parts[1:])
    )  # of the tool of the others, in each part
    assert left == pytest.approx(math.sqrt((mass_error**2 @ parts) / 8000.0), rel=0.1)
