"""What is said of errors holds, for an IMU with the errors of a real one: `coverage` has the cases."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from bota_ethercat.sensor.response import imu_noise
from tests.compensation import coverage, motion
from tests.compensation.coverage import CASES, KINDS, MOTIONS, Case, bounds, intervals, judged
from tests.compensation.making import SEED
from tests.simulation import more_if_long


def chance(share: float, count: float) -> float:
    """Three standard deviations of a share of so many."""
    return float(3.0 * np.sqrt(share * (1.0 - share) / count))


USUAL = [(name, 5) for name in ("poses", "poses and motion", "four poses and motion", "free, turned 3")]
TOUCHES = [("touched", 2), ("free, touched", 2)]
MINUTES = [(kind, name, Case(), 1) for kind in KINDS[:4:3] for name in MOTIONS]
CUT_OFF = Case(sinc_length=512, fir=True)  # at 3.9 Hz: below what a wrist and a polisher do
BOUNDS = [
    ("typed, tared", "pick", Case(), 20),
    ("poses and motion", "polishing", Case(), 2),
    ("free motion", "hand-guided", Case(sinc_length=512), 2),
    ("free motion", "rest", Case(fir=True), 2),
    ("poses and motion", "polishing", CUT_OFF, 4),
]
FILTERS = [Case(sinc_length=size, fir=fir) for size in (32, 64, 512) for fir in (False, True)]


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("name", "runs"), more_if_long(
    USUAL, USUAL + [(name, 200) for name in CASES if "touched" not in name]
))  # fmt: skip
def test_intervals_cover_95_percent(name: str, runs: int) -> None:
    """And are not far too wide; of blameless recordings at most one in a hundred is refused."""
    shares, refused, _ = intervals(CASES[name], runs, 1000 * SEED)
    assert len(refused) <= 0.01 * runs, refused[:3]
    for what, found in shares.items():
        if not what.startswith("("):
            held = np.mean(np.abs(found) <= 1.0)
            assert held > 0.91 - chance(0.91, runs), (name, what)
            assert runs < 200 or 1.96 * np.sqrt(np.mean(found**2)) > 0.5, (name, what)


@pytest.mark.parametrize("seed", [1000 * SEED, 6])  # of 6 a chip that is turned only explains less than noise
def test_noise_of_the_accelerometer_along_gravity_does_not_widen_the_interval_of_the_mass(seed: int) -> None:
    case = Case(seconds=0.0, sinc_length=512)  # quiet force, 100 samples a pose
    found = coverage.identified(case, motion.tool_of(seed), coverage.imu_of(seed, case), seed)
    by_noise = 1.5 / 9.81 * imu_noise(case.settings)[0] / np.sqrt(6 * 100)  # kg
    assert found.mass_interval < 0.7 * 1.96 * by_noise


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("name", "runs"), more_if_long(
    TOUCHES, TOUCHES + [(name, 100) for name, _ in TOUCHES]
))  # fmt: skip
def test_a_touch_is_named(name: str, runs: int) -> None:
    _, refused, noted = intervals(CASES[name], runs, 1000 * SEED)
    told = {line.split(":")[0] for line in [*refused, *noted] if "touched" in line}
    assert len(told) >= 0.95 * runs


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("kind", "name", "case", "runs"), more_if_long(
    BOUNDS, BOUNDS + [
        (kind, name, case, 100 if "typed" in kind else 20) for kind in KINDS for name in MOTIONS
        for case in FILTERS
    ]
))  # fmt: skip
def test_in_95_percent_of_samples_the_error_is_within_the_bounds(
    kind: str, name: str, case: Case, runs: int
) -> None:
    force, force_wide, left, torque, torque_wide, _ = judged(bounds(kind, name, case, runs, 1000 * SEED))
    assert (force > 92.0, torque > 92.0) == (True, True)
    assert (case, kind) == (CUT_OFF, "free motion") or max(force_wide, torque_wide) < 1.6
    if (name, case, "motion" in kind) == ("polishing", Case(), True):
        assert left < 0.30


def test_1_n_on_a_tool_of_2_kg_is_contact_within_100_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "tool_of", functools.partial(motion.tool_of, mass=2.0))
    seed = 1000 * SEED + 777
    imu, tool, rest = coverage.imu_of(seed), motion.tool_of(seed, 2.0), MOTIONS["rest"](seed)
    felt = coverage.felt_in(rest, tool, 21.0, Case(), imu, seed)
    pressed = (felt.times[:, None] % 1.0 > 0.9) * np.array([0.0, 0.0, -1.0])
    stream = coverage.stream_for("poses and motion", Case(), seed)
    assert coverage.contacts(stream, felt._replace(force=felt.force + pressed)) >= 19


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("kind", "name", "case", "minutes"), more_if_long(MINUTES, [
    *MINUTES, ("typed, tared", "wrist", Case(), 60),
    *(("poses and motion", name, case, 60) for name in MOTIONS for case in FILTERS),
]))  # fmt: skip
def test_in_an_hour_of_every_motion_it_is_contact_at_most_once(
    kind: str, name: str, case: Case, minutes: int
) -> None:
    assert coverage.alarms(kind, name, case, minutes, 1000 * SEED) <= minutes / 60
