"""How well the poses fit one payload, and what a person should know of it: sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from ft_compensation.identification.poses import Pose
from ft_compensation.identification.weighted import Array
from ft_compensation.quantities import length

ARM: Final = 0.05
"""m: what makes a torque of a force where the center of gravity is nearer."""
_SUSPICIOUS: Final = 3.0
_NEGLIGIBLE: Final = 0.01
"""Of the weight: a residual below it is not worth a word."""
_RARE: Final = 3.09
"""Standard deviations that noise exceeds once in a thousand times."""


class Fit(NamedTuple):
    """How well force or torque fits."""

    rms: float
    """Of the residuals, with the degrees of freedom taken into account, N or Nm."""
    degrees: float
    """Of freedom."""
    chi_square: float | None
    """Squares of the residuals in units of what the windows' noise explains, per degree of freedom: 1 is
    ideal. None where that noise is not known."""
    verdict: str
    """`noise` explains the residuals, or they are `small` (1 % of the weight) all the same, or `large`."""


def judge(poses: Sequence[Pose], residuals: Array, degrees: Array, name: str, weight: float) -> Fit:
    """How `residuals` (n, 3) of "force" or "torque" fit; `weight` in N, or Nm at its arm."""
    freedom = max(float(degrees.sum()), 1.0)
    rms = math.sqrt(float((residuals**2).sum()) / freedom)
    spread = np.array([getattr(pose, f"{name}_spread") for pose in poses])
    chi_square = None
    if spread.all():
        expected = spread**2 / np.array([[pose.samples] for pose in poses])
        chi_square = float((residuals**2 / expected).sum()) / freedom
        # The quantile by Wilson and Hilferty.
        ninth = 2.0 / (9.0 * freedom)
        if chi_square <= (1.0 - ninth + _RARE * math.sqrt(ninth)) ** 3:
            return Fit(rms, freedom, chi_square, "noise")
    return Fit(rms, freedom, chi_square, "small" if rms <= _NEGLIGIBLE * weight else "large")


def fit_notes(
    poses: Sequence[Pose], residuals: Array, fit: Fit, name: str, unit: str, weight: float
) -> Iterator[str]:
    """A pose that fits worse than the others, or residuals that noise does not explain; as for `judge`."""
    sizes = np.linalg.norm(residuals, axis=1)
    worst = int(sizes.argmax())
    others = float(np.sqrt(np.mean(np.delete(sizes, worst) ** 2)))
    by_chance = length(getattr(poses[worst], f"{name}_spread")) / poses[worst].samples ** 0.5
    if sizes[worst] > max(_SUSPICIOUS * others, _SUSPICIOUS * by_chance, _NEGLIGIBLE * weight):
        yield (
            f"pose {worst + 1} fits worse than the others: {sizes[worst]:.2g} {unit} of residual {name}; if "
            "something touched the tool, take it again"
        )
    elif fit.verdict == "large" and fit.chi_square is not None:
        yield (
            f"the residual {name}, {fit.rms:.2g} {unit}, is {math.sqrt(fit.chi_square):.0f} times what the "
            "noise explains: a cable pulls, the tool moves, or the orientation is not exact"
        )


def interval_notes(mass: float, mass_interval: float, centre_interval: float) -> Iterator[str]:
    """Of wide intervals; kg and m."""
    if mass_interval > 0.05 * mass:
        yield (
            f"the mass is known to ± {100 * mass_interval / mass:.0f} % only: take more poses, or longer ones"
        )
    if centre_interval > 0.01:
        yield (
            f"the center of gravity is known to ± {1000 * centre_interval:.0f} mm only: take more poses, or "
            "longer ones"
        )


def offset_notes(undetermined: str) -> Iterator[str]:
    """Of axes, as in "xz", whose offset of the accelerometer the poses do not determine."""
    if undetermined:
        yield (
            f"the poses do not determine the accelerometer's offset along {' and '.join(undetermined)}, so "
            "nearly none is assumed there: take poses with that axis once up and once down"
        )
