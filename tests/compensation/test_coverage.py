"""What is said of errors holds, for an IMU with the errors of a real one: `coverage` has the cases."""

from __future__ import annotations

import numpy as np
import pytest

from tests.compensation.coverage import CASES, KINDS, MOTIONS, Case, alarms, bounds, intervals, judged
from tests.compensation.making import SEED
from tests.simulation import more_if_long


def chance(share: float, count: float) -> float:
    """Three standard deviations of a share of so many."""
    return float(3.0 * np.sqrt(share * (1.0 - share) / count))


USUAL = [(name, 5) for name in ("poses", "poses and motion", "four poses and motion", "free, turned 3")]
TOUCHES = [("touched", 2), ("free, touched", 2)]
BOUNDS = [
    ("typed, tared", "pick", 64, 3),
    ("poses and motion", "polishing", 64, 2),
    ("free motion", "hand-guided", 512, 2),
]


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


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("name", "runs"), more_if_long(
    TOUCHES, TOUCHES + [(name, 100) for name, _ in TOUCHES]
))  # fmt: skip
def test_a_touch_is_named(name: str, runs: int) -> None:
    _, refused, noted = intervals(CASES[name], runs, 1000 * SEED)
    told = {line.split(":")[0] for line in [*refused, *noted] if "touched" in line}
    assert len(told) >= 0.95 * runs


WIDEST: dict[str, tuple[float, float]] = {
    "typed, tared": (1.6, 2.2), "tensor typed, tared": (1.6, 2.2), "poses": (1.6, 2.2),
}  # fmt: skip
"""Force, torque; a tensor that nobody knows, and a center within 2 mm, are those of any tool."""


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("kind", "name", "sinc_length", "runs"), more_if_long(
    BOUNDS, BOUNDS + [(kind, name, size, 20) for kind in KINDS for name in MOTIONS for size in (32, 64, 512)]
))  # fmt: skip
def test_in_95_percent_of_samples_the_error_is_within_the_bounds(
    kind: str, name: str, sinc_length: int, runs: int
) -> None:
    force, force_wide, left, torque, torque_wide, _ = judged(
        bounds(kind, name, Case(sinc_length=sinc_length), runs, 1000 * SEED)
    )
    most_force, most_torque = WIDEST.get(kind, (1.6, 1.6))
    assert (force > 92.0, torque > 92.0) == (True, True)
    assert (force_wide < most_force, torque_wide < most_torque) == (True, True)
    if (name, sinc_length, "motion" in kind) == ("polishing", 64, True):
        assert left < 0.30


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("sinc_length", [32, 64, 512])
@pytest.mark.parametrize("name", MOTIONS)
def test_in_an_hour_of_every_motion_it_is_contact_at_most_once(name: str, sinc_length: int) -> None:
    assert alarms("poses and motion", name, Case(sinc_length=sinc_length), 60, 1000 * SEED) <= 1
