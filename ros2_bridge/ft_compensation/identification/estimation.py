"""The equations of the poses and their answer, with intervals.

In every pose: force = m g + bias force, torque = c x g + bias torque, with c = m times the center of gravity.
Each axis of force and torque has a variance of its own. Where gravity is from the accelerometer, its offset
and sensitivities are unknowns too: with g = -G u / |u| and u = (a - offset) / scale, |u| = G is one more
equation a pose, and the directions enter force and torque. Of these six, what is typical of such an
accelerometer is assumed in advance: what the poses do not determine stays near zero with a wide interval.

Leading axes of the arrays, shown as `...`, are independent problems.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from ft_compensation.identification.weighted import Array, Known, Solution, solve, two_sided
from ft_compensation.quantities import OFFSET_PRIOR, SCALE_PRIOR

# m/s²: what is assumed of the length of a mean acceleration beyond offset and sensitivities, ...
_LENGTH_DEVIATION: Final = 0.002
_LENGTH_DEGREES: Final = 6.0  # ... as if it were estimated from so many residuals.
# N, Nm, m/s²: standard deviations below which nothing is believed, where equations of all kinds meet.
_FLOOR: Final = np.array([1e-6] * 3 + [1e-7] * 3 + [1e-6])
_FLOOR_ALONE: Final = 1e-12
# Of an axis' variance at the offset that the lengths alone give: six poses could be made to fit one axis
# perfectly by an offset that they hardly determine.
_LEAST_SHARE: Final = 0.3
_NOTHING: Final = 1e-9  # kg: no mass at all has its center anywhere
_FEW: Final = 3
_LENGTH_ROUNDS: Final = 3
_ROUNDS: Final = 9
_CONVERGED: Final = 1e-7


class Value(NamedTuple):
    """Some estimated quantities."""

    value: Array
    half: Array  # half the width of the confidence interval


class Estimate(NamedTuple):
    """The answer; shapes without the leading axes."""

    mass: Value  # (1,), kg
    center: Value  # (3,), m
    bias: Value  # (6,), N and Nm
    offset: Value | None  # (3,), m/s², of the accelerometer; None where gravity is not from it
    scale: Value | None  # (3,): what its axes read per m/s²
    gravity: Array  # (n, 3), m/s²: as far as known now
    residuals: Array  # (n, 6), N and Nm: measured minus modelled
    degrees: Array  # (6,): degrees of freedom of the residuals of each axis


def estimate(
    wrench: Array,
    gravity: Array,
    confidence: float = 0.95,
    acceleration: Array | None = None,
    acceleration_variance: Array | float = 0.0,
) -> Estimate:
    """Solve the poses: wrench (..., n, 6), N and Nm, and gravity (..., n, 3), in the sensor's frame, m/s².

    Also `acceleration` (..., n, 3), m/s², if gravity is from it, with `acceleration_variance` (...,) of its
    means by the sensor's noise, (m/s²)². LinAlgError if the equations leave an unknown open.
    """
    measured = np.swapaxes(wrench, -1, -2)
    scale = offset = None
    if acceleration is None or measured.shape[-1] <= _FEW:
        acceleration = None
        solution = _alone(gravity, measured)
    else:
        gravity, solution = _with_accelerometer(measured, acceleration, gravity, acceleration_variance)
    answer, unknowns = solution.answer, solution.answer.shape[-1]
    mass = answer[..., :1]
    divisor = np.where(np.abs(mass) < _NOTHING, _NOTHING, mass)
    center = answer[..., 4:7] / divisor
    rows = np.broadcast_to(np.eye(unknowns), (*answer.shape[:-1], unknowns, unknowns)).copy()
    # The center is c / m: to first order.
    rows[..., 4:7, :] /= divisor[..., np.newaxis]
    rows[..., 4:7, 0] = -center / divisor
    deviation, degrees = solution.student(rows)
    half = two_sided(confidence, degrees) * deviation
    if acceleration is not None:
        offset = Value(answer[..., 10:13], half[..., 10:13])
        scale = Value(1.0 + answer[..., 13:], half[..., 13:])
    degrees_of_axes = solution.degrees[..., :6]
    if solution.degrees.shape[-1] == 2:
        degrees_of_axes = np.repeat(solution.degrees / 3.0, 3, axis=-1)
    return Estimate(
        Value(mass, half[..., :1]),
        Value(center, half[..., 4:7]),
        Value(answer[..., [1, 2, 3, 7, 8, 9]], half[..., [1, 2, 3, 7, 8, 9]]),
        offset,
        scale,
        gravity,
        wrench - np.swapaxes(_times(_design(gravity), answer[..., :10]), -1, -2),
        degrees_of_axes,
    )


def _alone(gravity: Array, measured: Array, floor: float = _FLOOR_ALONE) -> Solution:
    """The ten unknowns of force and torque where gravity is known.

    Three poses leave too little for a variance of each axis: force has one then, and torque.
    """
    groups = 6 if measured.shape[-1] > _FEW else 2
    shape = (*measured.shape[:-2], groups, 6 // groups * measured.shape[-1])
    design = _design(gravity).reshape(*shape, 10)
    return solve(design, measured.reshape(shape), Known(np.zeros((10, 10)), np.full(groups, floor**2)))


class _Linear(NamedTuple):
    """The equations of the accelerometer about an offset and scale."""

    gravity: Array  # (..., n, 3)
    turn: Array  # (..., n, 3, 6): change of gravity by offset and scale
    stretch: Array  # (..., 1, n, 6): change of the length of u
    excess: Array  # (..., 1, n): by how much gravity is longer than u


def _linearize(acceleration: Array, size: Array, calibration: Array) -> _Linear:
    """About `calibration` (..., 6): offset, scale - 1. `size` (..., n) is the magnitude of gravity."""
    scale = 1.0 + calibration[..., np.newaxis, 3:]
    u = (acceleration - calibration[..., np.newaxis, :3]) / scale
    length = np.linalg.norm(u, axis=-1)
    up = u / length[..., np.newaxis]
    # Of each component of u by the offset and the scale of its own axis.
    change = np.concatenate([np.broadcast_to(-1.0 / scale, u.shape), -u / scale], axis=-1)
    across = np.eye(3) - up[..., :, np.newaxis] * up[..., np.newaxis, :]
    turn = np.concatenate([across, across], axis=-1) * change[..., np.newaxis, :]
    return _Linear(
        -size[..., np.newaxis] * up,
        -(size / length)[..., np.newaxis, np.newaxis] * turn,
        (np.concatenate([up, up], axis=-1) * change)[..., np.newaxis, :, :],
        (size - length)[..., np.newaxis, :],
    )


def _with_accelerometer(
    measured: Array, acceleration: Array, gravity: Array, noise: Array | float
) -> tuple[Array, Solution]:
    """Gravity (..., n, 3) and sixteen unknowns: ten as before, offset, scale - 1; by Gauss and Newton.

    The lengths alone come first: the errors of an uncorrected direction would pass for noise.
    """
    size = np.linalg.norm(gravity, axis=-1)
    prior = np.diag([OFFSET_PRIOR**-2] * 3 + [SCALE_PRIOR**-2] * 3)
    assumed = np.zeros((*measured.shape[:-2], 7))
    assumed[..., 6] = _LENGTH_DEVIATION**2 + noise
    degrees = np.array([0.0] * 6 + [_LENGTH_DEGREES])
    lengths = Known(prior, _FLOOR[6:] ** 2, degrees[6:], assumed[..., 6:])
    calibration = np.zeros((*measured.shape[:-2], 6))
    for _ in range(_LENGTH_ROUNDS):
        at = _linearize(acceleration, size, calibration)
        only = solve(at.stretch, at.excess + _times(at.stretch, calibration), lengths)
        calibration = only.answer
    at = _linearize(acceleration, size, calibration)
    first = _alone(at.gravity, measured, _FLOOR[3])
    answer = np.concatenate([first.answer, calibration], axis=-1)
    variances = np.concatenate([first.variances, only.variances], axis=-1)
    information = np.zeros((16, 16))
    information[10:, 10:] = prior
    known = Known(information, np.maximum(_LEAST_SHARE * variances, _FLOOR**2), degrees, assumed)
    for _ in range(_ROUNDS):
        design = np.zeros((*measured.shape[:-2], 7, measured.shape[-1], 16))
        design[..., :6, :, :10] = _design(at.gravity)
        turn = np.moveaxis(at.turn, -2, -3)
        design[..., :3, :, 10:] = answer[..., 0, np.newaxis, np.newaxis, np.newaxis] * turn
        moment = answer[..., 4:7]
        design[..., 3:6, :, 10:] = np.cross(moment[..., :, np.newaxis, np.newaxis], turn, axis=-3)
        design[..., 6:, :, 10:] = at.stretch
        # Gravity has the present offset and scale in it already, and the linear equations add them.
        twice = _times(design[..., 10:], answer[..., 10:])
        target = np.concatenate([measured, at.excess], axis=-2) + twice
        solution = solve(design, target, known, variances)
        moved = np.abs(solution.answer - answer)[..., 10:].max()
        answer, variances = solution.answer, solution.variances
        at = _linearize(acceleration, size, answer[..., 10:])
        if moved <= _CONVERGED:
            break
    return at.gravity, solution


def _times(design: Array, answer: Array) -> Array:
    """(..., k, n) of (..., k, n, p) and (..., p)."""
    return (design @ answer[..., np.newaxis, :, np.newaxis])[..., 0]


def _design(gravity: Array) -> Array:
    """(..., 6, n, 10): m, bias force, c, bias torque, for each axis of force and torque."""
    design = np.zeros((*gravity.shape[:-2], 6, gravity.shape[-2], 10))
    for axis, after, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        design[..., axis, :, 0] = gravity[..., axis]
        design[..., axis, :, 1 + axis] = 1.0
        design[..., 3 + axis, :, 4 + after] = gravity[..., last]
        design[..., 3 + axis, :, 4 + last] = -gravity[..., after]
        design[..., 3 + axis, :, 7 + axis] = 1.0
    return design
