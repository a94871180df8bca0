"""Payload identification: mass, center of gravity and bias by least squares from static poses.

In every pose: force = m g + bias force, torque = c x g + bias torque, with c = m times the center of gravity.
The ten unknowns are linear, and the force and torque equations share none of them, so two least-squares
problems with units of their own are solved: m and three of the bias from 3 n equations, c and three from 3 n.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ft_compensation.identification.poses import MOST_POSES, Coverage, Pose, coverage
from ft_compensation.identification.student import two_sided
from ft_compensation.quantities import CompensationError, Payload, Wrench, length
from protocol.pdo import Vector3

LARGEST_MASS: Final = 500.0
"""kg: no sensor of the family carries more."""
LARGEST_CENTRE: Final = 2.0
"""m"""
_LARGEST_MISFIT: Final = 0.1
_FORGIVEN_MISFIT: Final = 1.0
"""N: residuals are refused beyond this plus a tenth of the weight."""
_SUSPICIOUS: Final = 3.0
_NEGLIGIBLE: Final = 0.01
"""Of the weight: a residual below it is not worth a word."""
_ARM: Final = 0.05
"""m: what makes a torque of it."""

Array = NDArray[np.float64]


class IdentificationError(CompensationError):
    """The poses do not give an answer; the text is one sentence that says why and what to do."""


class Residual(NamedTuple):
    """What the answer leaves of one pose: measured minus modelled."""

    force: Vector3
    """N"""
    torque: Vector3
    """Nm"""


class Identified(NamedTuple):
    """The answer. Every `..._interval` is half the width of the confidence interval."""

    payload: Payload
    bias: Wrench
    gravity: float
    """Its magnitude in the poses, m/s²."""
    mass_interval: float
    """kg"""
    centre_interval: Vector3
    """m"""
    bias_interval: Wrench
    """N, Nm"""
    confidence: float
    """Of the intervals: 0.95 as a rule. Student's t, from what the residuals scatter."""
    residuals: tuple[Residual, ...]
    """One a pose, in order."""
    force_rms: float
    """Of the residuals, with the degrees of freedom taken into account, N."""
    torque_rms: float
    """Likewise, Nm."""
    condition: float
    """Of the problem with each unknown in a unit of its own size: 1.2 is ideal, beyond 10 is bad."""
    coverage: Coverage
    notes: tuple[str, ...]
    """What a person should know, sentences: a pose that does not fit, a wide interval."""


def identify(poses: Sequence[Pose], *, confidence: float = 0.95, one_axis: bool = False) -> Identified:
    """Mass, center of gravity and bias from `poses`. IdentificationError, a sentence, where they do not
    suffice.

    Args:
        poses: at least four, whose directions of gravity do not lie in one plane; six with each axis of the
            sensor once up and once down are best.
        confidence: of the intervals.
        one_axis: take poses that turn about one axis only, if there are three or more. The equations have an
            answer then, but nothing contradicts an error in the direction that never changed.
    """
    if len(poses) > MOST_POSES:
        raise IdentificationError(f"{len(poses)} poses are more than the {MOST_POSES} that are taken")
    if not all(np.isfinite([*pose.wrench.values, *pose.gravity]).all() for pose in poses):
        raise IdentificationError("a pose has numbers that are not finite")
    seen = coverage(poses, one_axis=one_axis)
    if seen.missing is not None:
        raise IdentificationError(f"the poses do not suffice: {seen.missing}; {seen.next_pose}")
    gravity = np.array([pose.gravity for pose in poses])
    wrench = np.array([pose.wrench.values for pose in poses])
    force = _solve(_force_design(gravity), wrench[:, :3])
    torque = _solve(_torque_design(gravity), wrench[:, 3:])
    mass = float(force.answer[0])
    t_force, t_torque = (two_sided(confidence, part.degrees) for part in (force, torque))
    mass_interval = t_force * float(force.deviation[0])
    _check_mass(mass, mass_interval)
    center = torque.answer[:3] / mass
    # c and m come from separate equations, so their errors add as squares.
    deviation = np.hypot(torque.deviation[:3], center * force.deviation[0]) / mass
    centre_interval = _triple(max(t_force, t_torque) * deviation)
    residuals = tuple(
        Residual(_triple(f), _triple(m)) for f, m in zip(force.residuals, torque.residuals, strict=True)
    )
    _check_fit(force, mass * float(np.linalg.norm(gravity, axis=1).mean()))
    if float(np.linalg.norm(center)) > LARGEST_CENTRE:
        raise IdentificationError(
            f"the center of gravity would be {np.linalg.norm(center):.2g} m from the sensor with a mass of "
            f"{mass:.3g} kg, which cannot be: something held or touched the tool, or there is no tool"
        )
    return Identified(
        Payload(mass, _triple(center)),
        Wrench(_triple(force.answer[1:]), _triple(torque.answer[3:])),
        float(np.linalg.norm(gravity, axis=1).mean()),
        mass_interval,
        centre_interval,
        Wrench(_triple(t_force * force.deviation[1:]), _triple(t_torque * torque.deviation[3:])),
        confidence,
        residuals,
        force.rms,
        torque.rms,
        _condition(gravity),
        seen,
        tuple(_notes(poses, residuals, mass, mass_interval, centre_interval)),
    )


class _Solution(NamedTuple):
    answer: Array
    deviation: Array
    """Standard deviation of each unknown."""
    residuals: Array
    rms: float
    degrees: int


def _force_design(gravity: Array) -> Array:
    """(3 n, 4): m, then the bias force."""
    design = np.zeros((len(gravity), 3, 4))
    design[:, :, 0] = gravity
    design[:, :, 1:] = np.eye(3)
    return design.reshape(-1, 4)


def _torque_design(gravity: Array) -> Array:
    """(3 n, 6): c, as in c x g, then the bias torque."""
    design = np.zeros((len(gravity), 3, 6))
    gx, gy, gz = gravity.T
    design[:, 0, 1], design[:, 0, 2] = gz, -gy
    design[:, 1, 0], design[:, 1, 2] = -gz, gx
    design[:, 2, 0], design[:, 2, 1] = gy, -gx
    design[:, :, 3:] = np.eye(3)
    return design.reshape(-1, 6)


def _solve(design: Array, measured: Array) -> _Solution:
    found, _, rank, _ = np.linalg.lstsq(design, measured.reshape(-1), rcond=None)
    answer = found.astype(np.float64)
    unknowns = design.shape[1]
    if rank < unknowns:
        raise IdentificationError("the poses do not suffice: their equations leave an unknown open")
    residuals = measured.reshape(-1) - design @ answer
    degrees = len(residuals) - unknowns
    variance = float(residuals @ residuals) / degrees
    deviation: Array = np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    return _Solution(answer, deviation, residuals.reshape(-1, 3), variance**0.5, degrees)


def _condition(gravity: Array) -> float:
    """Ratio of the best to the worst seen combination of mass and center, the bias being free.

    Force equations in N with the mass, torque equations in N at an arm L with the center in units of L: L
    cancels.
    """
    moved = gravity - gravity.mean(axis=0)
    information = np.zeros((4, 4))
    for g in moved:
        information[0, 0] += g @ g
        information[1:, 1:] += (g @ g) * np.eye(3) - np.outer(g, g)
    values = np.linalg.eigvalsh(information)
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else float("inf")


def _check_mass(mass: float, interval: float) -> None:
    if mass < -interval:
        raise IdentificationError(
            f"the mass would be negative ({mass:.3g} kg): force and gravity have opposite signs, so the "
            "frame or sign of one of them is wrong, or the tool was lifted"
        )
    if mass <= interval or mass <= 0.0:
        raise IdentificationError(
            f"the mass, {mass:.2g} kg, cannot be told from zero (± {interval:.2g} kg): without a tool take "
            "only the bias, with a light one take more and longer poses"
        )
    if mass > LARGEST_MASS:
        raise IdentificationError(
            f"a mass of {mass:.3g} kg cannot hang on a sensor: check the units of the force"
        )


def _check_fit(force: _Solution, weight: float) -> None:
    limit = _FORGIVEN_MISFIT + _LARGEST_MISFIT * weight
    if force.rms > limit:
        worst = int(np.linalg.norm(force.residuals, axis=1).argmax())
        raise IdentificationError(
            f"the poses do not fit one payload: the residual is {force.rms:.2g} N, the limit {limit:.2g} N; "
            f"pose {worst + 1} fits worst; something touched the tool, or it moved: take that pose "
            "again"
        )


def _notes(
    poses: Sequence[Pose],
    residuals: Sequence[Residual],
    mass: float,
    mass_interval: float,
    centre_interval: Vector3,
) -> list[str]:
    notes = []
    weight = mass * length(poses[0].gravity)
    for name, unit, negligible, spreads in (
        ("force", "N", _NEGLIGIBLE * weight, [pose.force_spread for pose in poses]),
        ("torque", "Nm", _NEGLIGIBLE * weight * _ARM, [pose.torque_spread for pose in poses]),
    ):
        sizes = np.array([length(getattr(residual, name)) for residual in residuals])
        worst = int(sizes.argmax())
        others = float(np.sqrt(np.mean(np.delete(sizes, worst) ** 2)))
        by_chance = length(spreads[worst]) / poses[worst].samples ** 0.5
        if sizes[worst] > max(_SUSPICIOUS * others, _SUSPICIOUS * by_chance, negligible):
            notes.append(
                f"pose {worst + 1} fits worse than the others: {sizes[worst]:.2g} {unit} of residual "
                f"{name}; if something touched the tool, take it again"
            )
    if mass_interval > 0.05 * mass:
        notes.append(
            f"the mass is known to ± {100 * mass_interval / mass:.0f} % only: take more poses, or longer ones"
        )
    if length(centre_interval) > 0.01:
        notes.append(
            f"the center of gravity is known to ± {1000 * length(centre_interval):.0f} mm only: take more "
            "poses, or longer ones"
        )
    return notes


def _triple(values: Array) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z
