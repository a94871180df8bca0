"""Gravity from the accelerometer over the moves of an arm, by another simulation than the virtual sensor."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.compensation import gravity_table
from tests.compensation.estimators import ESTIMATORS, Found, before, compensated, node
from tests.compensation.moves import (
    HEALTHY,
    TURN_RATE,
    Array,
    Imu,
    Move,
    acceptance,
    along,
    feel,
    moves,
    there_and_back,
    vibration,
)

PAGE = Path(__file__).parents[2] / "docs" / "compensation.md"
RMS_DEG, WORST_DEG = 1.0, 2.5
MASS = 2.0
"""kg"""


def survived(rate_hz: float, seed: int, imu: Imu = HEALTHY, lost: float = 0.0) -> list[Found]:
    """All moves, a pose and noise of its own each."""
    return [node(feel(move, rate_hz, seed + number, imu, lost)) for number, move in enumerate(moves())]


def coverage(found: list[Found]) -> float:
    """The share of the answers whose tilt was said to be possible."""
    answered = [(each.error, each.covers) for each in found]
    error, covers = (np.concatenate(parts) for parts in zip(*answered, strict=True))
    known = ~np.isnan(error)
    return float(np.mean(error[known] <= covers[known]))


def check(found: list[Found]) -> None:
    rms, worst = gravity_table.figures(found)
    assert rms < RMS_DEG
    assert worst < WORST_DEG
    assert coverage(found) > 0.95


def test_every_move_is_survived() -> None:
    """At 200 Hz, with every tenth sample lost."""
    check(survived(200.0, 1, lost=0.1))


@pytest.mark.long
@pytest.mark.parametrize("rate_hz", [100.0, 400.0, 800.0, 1600.0])
@pytest.mark.parametrize("seed", [1000, 2000])
def test_every_move_is_survived_at_every_rate(rate_hz: float, seed: int) -> None:
    check(survived(rate_hz, seed))


@pytest.mark.long
def test_every_move_is_survived_with_the_most_noise_that_the_maker_allows() -> None:
    check(survived(400.0, 3000, Imu(acceleration_noise=0.1, rate_noise=0.01)))


@pytest.mark.long
@pytest.mark.parametrize("imu", [Imu(rate_scale=0.01), Imu(acceleration_offset=0.2), Imu(rate_offset=0.05)])
def test_what_the_sensor_itself_is_off_is_covered(imu: Imu) -> None:
    assert coverage(survived(400.0, 4000, imu)) > 0.95


@pytest.mark.parametrize("rate_hz", [400.0, 800.0, 1600.0])
def test_a_start_in_a_vibration(rate_hz: float) -> None:
    """It is not white: more samples of it do not make the mean better, nor is it rest."""
    found = node(feel(Move("vibration", 6.0, vibration(0, 31.0), rests=False), rate_hz, 1077))
    check([found])
    assert np.isfinite(found.error[-10:]).all()


@pytest.mark.parametrize("seed", [10, 11, 12])
def test_a_start_in_a_gentle_move(seed: int) -> None:
    """1 m/s² for a second does not change the length of the acceleration: only waiting tells."""
    found = node(feel(Move("start", *there_and_back(0, 1.0, 1.0), rests=False), 400.0, seed))
    assert coverage([found]) == 1.0
    assert np.degrees(np.nanmax(found.error)) < 3.0, "it was 5"


def test_a_noisy_sensor_at_rest() -> None:
    """Five times the noise that the maker allows: now and then a block contradicts by chance."""
    check([node(feel(Move("rest", 10.0), 100.0, 3, Imu(acceleration_noise=0.5, rate_noise=0.03)))])


@pytest.mark.parametrize("rate_hz", [100.0, 800.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_move_that_passed_for_tilt(rate_hz: float, axis: int) -> None:
    """0.4 s at 2.5 m/s² across gravity and back: the tool's own 5.0 N, then nothing when the arm rests."""
    felt = feel(acceptance(axis), rate_hz, seed=axis)
    force = np.linalg.norm(compensated(felt, MASS), axis=1)
    moving = np.linalg.norm(felt.own, axis=1) > 1.0
    assert force[moving].min() > 4.4
    assert force[moving].max() < 6.2
    assert force[felt.times > 2.8].max() < 0.5
    assert np.isfinite(force[felt.times > 1.0]).all()
    # What it was: more than a third of the force was shown as tilt, and the other way round.
    assert np.nanmax(np.degrees(before(felt).error)) > 5.0


def _without_rest(t: Array) -> Array:
    return along(0, 3.0 * np.sin(2 * np.pi * 0.7 * t))


def _to_and_fro(t: Array) -> Array:
    return along(0, np.where(np.floor(t / 0.5) % 4 % 3, -2.5, 2.5))


@pytest.mark.parametrize(
    "move",
    [
        Move("sine", 30.0, _without_rest),
        Move("to and fro", 40.0, _to_and_fro),
        Move("to and fro, turning", 30.0, _to_and_fro, TURN_RATE, 1),
    ],
    ids=lambda move: move.kind,
)
def test_an_arm_that_never_rests_is_told_how_uncertain_gravity_is(move: Move) -> None:
    """Only the gyroscope is right then; an accelerometer that is always accelerated must not be believed."""
    found = node(feel(move, 100.0, 5))
    assert coverage([found]) > 0.95
    assert np.isfinite(found.error[200:]).all(), "it goes on"


@pytest.mark.parametrize("rate", [0.0, 0.5])
@pytest.mark.parametrize("acceleration", [_without_rest, _to_and_fro])
def test_a_start_with_an_arm_that_never_rests(acceleration: Callable[[Array], Array], rate: float) -> None:
    """Its velocity tells in the end where gravity points."""
    found = node(feel(Move("start", 100.0, acceleration, rate, 1, rests=False), 100.0, 8))
    assert coverage([found]) > 0.95
    assert np.isfinite(found.error[3000:5000]).all()
    check([found])


@pytest.mark.long
def test_the_page_has_the_figures_of_the_simulation() -> None:
    text = PAGE.read_text()
    for kind, cells in gravity_table.table():
        (row,) = re.findall(rf"^\| {kind} \|(.*)\|$", text, re.MULTILINE)
        said = [float(number) for number in re.findall(r"[\d.]+", row)]
        assert said == pytest.approx([part for cell in cells for part in cell], rel=0.1, abs=0.1), kind
    assert "| Tilt, rms/worst, ° | " + " | ".join(ESTIMATORS) + " |" in text
