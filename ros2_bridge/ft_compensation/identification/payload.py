"""Payload identification: mass, center of gravity, bias and the accelerometer's offset from static poses.

Checks what is given, has `estimation` solve it, and judges how well the poses fit one payload.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.pdo import Vector3
from ft_compensation.identification.estimation import Value, estimate
from ft_compensation.identification.poses import MOST_POSES, Coverage, Pose, coverage
from ft_compensation.identification.weighted import Array
from ft_compensation.quantities import (
    NORMAL_95,
    OFFSET_PRIOR,
    Accelerometer,
    CompensationError,
    Payload,
    Wrench,
    length,
)
from ft_compensation.stationary import triple

LARGEST_MASS: Final = 500.0  # kg: no sensor of the family carries more
LARGEST_CENTRE: Final = 2.0  # m
_LARGEST_MISFIT: Final = 0.1
# N: residuals are refused beyond this plus a tenth of the weight; torques at the arm of the weight.
_FORGIVEN_MISFIT: Final = 1.0
# Of the interval before anything is measured: an offset no better known than so is not determined.
_UNKNOWN: Final = 0.5

ARM: Final = 0.05  # m: what makes a torque of a force where the center of gravity is nearer
_SUSPICIOUS: Final = 3.0
_NEGLIGIBLE: Final = 0.01  # of the weight: a residual below it is not worth a word
_RARE: Final = 3.09  # standard deviations that noise exceeds once in a thousand times


class IdentificationError(CompensationError):
    """The poses do not give an answer; the text is one sentence that says why and what to do."""


class Fit(NamedTuple):
    """How well force or torque fits."""

    rms: float  # of the residuals, with the degrees of freedom taken into account, N or Nm
    degrees: float  # of freedom
    # Squares of the residuals in units of what the windows' noise explains, per degree of freedom: 1 is
    # ideal. None where that noise is not known.
    chi_square: float | None
    # `noise` explains the residuals, or they are `small` (1 % of the weight) all the same, or `large`.
    verdict: str


class OffsetFit(NamedTuple):
    """What the poses say of the accelerometer."""

    calibration: Accelerometer
    undetermined: str  # axes whose offset the poses do not determine: "", "x", ...


class Identified(NamedTuple):
    """The answer. Every `..._interval` is half the width of the confidence interval."""

    payload: Payload
    bias: Wrench
    gravity: float  # its magnitude in the poses, m/s²
    mass_interval: float  # kg
    centre_interval: Vector3  # m
    bias_interval: Wrench  # N, Nm
    # Of the intervals: 0.95 as a rule. Student's t; each axis has the variance that its residuals show.
    confidence: float
    residuals: tuple[Wrench, ...]  # what the answer leaves of each pose, in order: measured minus modelled
    force_rms: float  # of the residuals, with the degrees of freedom taken into account, N
    torque_rms: float  # likewise, Nm
    # Of the problem with each unknown in a unit of its own size: 1.2 is ideal, beyond 10 is bad.
    condition: float
    coverage: Coverage
    notes: tuple[str, ...]  # what a person should know, sentences: a pose that does not fit, a wide interval
    force_fit: Fit
    torque_fit: Fit
    accelerometer: OffsetFit | None  # None where gravity is not from it: it is not touched then


def identify(poses: Sequence[Pose], *, confidence: float = 0.95, one_axis: bool = False) -> Identified:
    """Mass, center of gravity and bias from `poses`.

    At least four, whose directions of gravity do not lie in one plane; six with each axis of the sensor once
    up and once down are best. If every pose has its `acceleration`, the accelerometer's offset and
    sensitivities are found too. IdentificationError, a sentence, where the poses do not suffice.

    `one_axis` takes poses that turn about one axis only, if there are three or more. The equations have an
    answer then, but nothing contradicts an error in the direction that never changed.
    """
    if len(poses) > MOST_POSES:
        raise IdentificationError(f"{len(poses)} poses are more than the {MOST_POSES} that are taken")
    if not all(
        np.isfinite([*pose.wrench.values, *pose.gravity, *(pose.acceleration or ())]).all() for pose in poses
    ):
        raise IdentificationError("a pose has numbers that are not finite")
    seen = coverage(poses, one_axis=one_axis)
    if seen.missing is not None:
        raise IdentificationError(f"the poses do not suffice: {seen.missing}; {seen.next_pose}")
    gravity = np.array([pose.gravity for pose in poses])
    wrench = np.array([pose.wrench.values for pose in poses])
    read = [pose.acceleration for pose in poses if pose.acceleration is not None]
    noise = float(np.mean([length(pose.acceleration_spread) ** 2 / 3.0 / pose.samples for pose in poses]))
    try:
        found = estimate(
            wrench, gravity, confidence, np.array(read) if len(read) == len(poses) else None, noise
        )
    except np.linalg.LinAlgError:
        raise IdentificationError("the poses do not suffice: their equations leave an unknown open") from None
    mass, mass_interval = float(found.mass.value[0]), float(found.mass.half[0])
    _check_mass(mass, mass_interval)
    payload = Payload(mass, triple(found.center.value))
    weight = mass * float(np.linalg.norm(gravity, axis=1).mean())
    moment = weight * max(ARM, length(payload.center))
    forces, torques = found.residuals[:, :3], found.residuals[:, 3:]
    force = judge(poses, forces, found.degrees[:3], "force", weight)
    torque = judge(poses, torques, found.degrees[3:], "torque", moment)
    _check_fit(force, forces, _FORGIVEN_MISFIT + _LARGEST_MISFIT * weight, "N")
    if length(payload.center) > LARGEST_CENTRE:
        raise IdentificationError(
            f"the center of gravity would be {length(payload.center):.2g} m from the sensor with a mass of "
            f"{mass:.3g} kg, which cannot be: something held or touched the tool, or there is no tool"
        )
    _check_fit(torque, torques, _FORGIVEN_MISFIT * ARM + _LARGEST_MISFIT * moment, "Nm")
    residuals = tuple(map(Wrench.of, found.residuals.tolist()))
    centre_interval = triple(found.center.half)
    accelerometer = _accelerometer(found.offset, found.scale)
    undetermined = accelerometer.undetermined if accelerometer else ""
    return Identified(
        payload,
        Wrench.of(found.bias.value.tolist()),
        float(np.linalg.norm(gravity, axis=1).mean()),
        mass_interval,
        centre_interval,
        Wrench.of(found.bias.half.tolist()),
        confidence,
        residuals,
        force.rms,
        torque.rms,
        _condition(gravity),
        seen,
        (
            *_fit_notes(poses, forces, force, "force", "N", weight),
            *_fit_notes(poses, torques, torque, "torque", "Nm", moment),
            *_other_notes(mass, mass_interval, length(centre_interval), undetermined),
        ),
        force,
        torque,
        accelerometer,
    )


def _accelerometer(offset: Value | None, scale: Value | None) -> OffsetFit | None:
    if offset is None or scale is None:
        return None
    limit = _UNKNOWN * NORMAL_95 * OFFSET_PRIOR
    open_axes = "".join(axis for axis, half in zip("xyz", offset.half, strict=True) if half > limit)
    values = offset.value, scale.value, offset.half, scale.half
    return OffsetFit(Accelerometer(*map(triple, values)), open_axes)


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


def _check_fit(fit: Fit, residuals: Array, limit: float, unit: str) -> None:
    if fit.rms > limit:
        worst = int(np.linalg.norm(residuals, axis=1).argmax())
        raise IdentificationError(
            f"the poses do not fit one payload: the residual is {fit.rms:.2g} {unit}, the limit {limit:.2g} "
            f"{unit}; pose {worst + 1} fits worst; something touched the tool, or it moved: take that pose "
            "again"
        )


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


def _fit_notes(
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


def _other_notes(mass: float, mass_half: float, centre_half: float, undetermined: str) -> Iterator[str]:
    """Of wide intervals, kg and m, and of axes, as in "xz", whose offset of the accelerometer is open."""
    more = "take more poses, or longer ones"
    if mass_half > 0.05 * mass:
        yield f"the mass is known to ± {100 * mass_half / mass:.0f} % only: {more}"
    if centre_half > 0.01:
        yield f"the center of gravity is known to ± {1000 * centre_half:.0f} mm only: {more}"
    if undetermined:
        yield (
            f"the poses do not determine the accelerometer's offset along {' and '.join(undetermined)}, so "
            "nearly none is assumed there: take poses with that axis once up and once down"
        )


def summary(result: Identified) -> str:
    """The answer in one sentence with its confidence interval, and the notes as further ones."""
    x, y, z = (1000.0 * part for part in result.payload.center)
    ix, iy, iz = (1000.0 * part for part in result.centre_interval)
    text = (
        f"mass {result.payload.mass:.4f} ± {result.mass_interval:.4f} kg, center of gravity ({x:.2f} ± "
        f"{ix:.2f}, {y:.2f} ± {iy:.2f}, {z:.2f} ± {iz:.2f}) mm ({100 * result.confidence:g} % confidence) "
        f"from {result.coverage.poses} poses; residual {result.force_rms:.2g} N "
        f"({result.force_fit.verdict}), {result.torque_rms:.2g} Nm ({result.torque_fit.verdict})"
    )
    return ". ".join([text, *result.notes])


def accelerometer_text(fit: OffsetFit) -> str:
    """Offset and sensitivities of the accelerometer with their confidence intervals, a sentence."""
    found = fit.calibration
    axes = zip("xyz", found.offset, found.offset_interval, strict=True)
    offset = ", ".join(f"{axis} {value:.3f} ± {half:.3f}" for axis, value, half in axes)
    axes = zip("xyz", found.scale, found.scale_interval, strict=True)
    scale = ", ".join(f"{axis} {value:.4f} ± {half:.4f}" for axis, value, half in axes)
    return f"Accelerometer: offset {offset} m/s², scale {scale}"
