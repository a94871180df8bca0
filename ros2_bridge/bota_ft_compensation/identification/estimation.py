# SPDX-License-Identifier: Apache-2.0
"""The equations of the poses and their answer, with intervals.

In every pose: force = m g + bias force, torque = c x g + bias torque, with c = m times the center of gravity.
Each axis of force and torque has a variance of its own. Where gravity is from the accelerometer, its offset,
sensitivities and cross-axis terms are unknowns too: with g = -G u / |u| and u = (1 - K) (a - offset) / scale,
|u| = G is one more equation a pose, and the directions enter force and torque. Of these twelve, what is
typical of such an accelerometer is assumed in advance: what the poses do not determine stays near zero, its
interval wide. Where gravity is from the orientation of a robot, the sensor may be mounted turned by about a
degree, likewise: g + turn x g. A regressor (time, or the indicator of one pose) may shift each axis of force
and torque.

Leading axes of the arrays, shown as `...`, are independent problems.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from bota_ft_compensation.identification.weighted import (
    Array,
    Known,
    Solution,
    solve,
    students_t,
)
from bota_ft_compensation.quantities import NORMAL_95, OFFSET_PRIOR, SCALE_PRIOR

# m/s²: what is assumed of the length of a mean acceleration beyond offset and sensitivities, ...
_LENGTH_DEVIATION: Final = 0.0005
_LENGTH_DEGREES: Final = 6.0  # ... as if it were estimated from so many residuals.
_NOISE_DEGREES: Final = 30.0  # likewise of force and torque, where the windows' noise explains what is left
# N, Nm, m/s²: standard deviations below which nothing is believed, where equations of all kinds meet.
_FLOOR: Final = np.array([1e-4] * 3 + [1e-5] * 3 + [1e-4])
_FLOOR_ALONE: Final = 1e-12
# Of an axis' variance at the offset that the lengths alone give: six poses could be made to fit one axis
# perfectly by an offset that they hardly determine.
_LEAST_SHARE: Final = 0.3
_MOUNTING: Final = 0.01  # rad: standard deviation of the mounting about each axis
CHIP_TURN: Final = 0.03  # rad: likewise of the IMU's chip, against force and torque
_NOTHING: Final = 1e-9  # kg: no mass at all has its center anywhere
_OF_CALIBRATION: Final = 12  # unknowns: offset, scale - 1, cross-axis terms
_FIXED: Final = 1e-7  # standard deviation of what is not free
CROSS_ROW, CROSS_COLUMN = np.nonzero(~np.eye(3, dtype=bool))  # of the cross-axis terms, as CROSS_AXES
_LENGTH_ROUNDS: Final = 3
_ROUNDS: Final = 9
_CONVERGED: Final = 1e-7


def calibration_prior(*, scale: bool = False, turn: bool = False, crossed: bool = False) -> Array:
    """(12, 12), the information that is assumed in advance of the calibration, of which the offset is fitted,
    and what is given here; `turn`: the accelerometer as a whole, about each axis.
    """
    variances = np.diag([OFFSET_PRIOR**2] * 3 + [SCALE_PRIOR**2 if scale else _FIXED**2] * 3 + [0.0] * 6)
    own = SCALE_PRIOR if crossed else _FIXED
    variances[6:, 6:] = own**2 * np.eye(6) + (CHIP_TURN**2 * OF_TURN @ OF_TURN.T if turn or crossed else 0.0)
    return np.linalg.inv(variances)


# (6, 3): of the cross-axis terms, what a chip that is turned by a small rotation vector makes of them.
OF_TURN: Final = -np.cross(np.eye(3), np.eye(3)[:, np.newaxis])[CROSS_COLUMN, :, CROSS_ROW]
FULL_CALIBRATION: Final = calibration_prior(scale=True, crossed=True)


class Value(NamedTuple):
    value: Array
    half: Array  # half the width of the interval, of `CONFIDENCE`


class Estimate(NamedTuple):
    """The answer; shapes without the leading axes."""

    mass: Value  # (1,), kg
    center: Value  # (3,), m
    bias: Value  # (6,), N and Nm
    # Of the accelerometer: offset (3,), m/s², scale (3,): what its axes read per m/s², cross-axis terms (6,).
    calibration: tuple[Value, Value, Value] | None  # None where gravity is not from it
    # (3,), rad: by which gravity is turned in the sensor's frame, beyond what its orientation tells.
    mounting: Value | None  # None if it is not looked for
    shift: Value | None  # (6,), N and Nm for each unit of the regressor
    gravity: Array  # (n, 3), m/s²: as far as known now
    residuals: Array  # (n, 6), N and Nm: measured minus modelled
    degrees: Array  # (6,): degrees of freedom of the residuals of each axis
    excess: Array  # (n,), m/s²: by how much gravity is longer than the corrected acceleration; zeros without
    # Mass, bias force, moment, bias torque, and calibration or mounting, and their covariance, with Student's
    # t in it, so that it is that of normal errors.
    unknowns: Array
    covariance: Array


def estimate(
    wrench: Array,
    gravity: Array,
    acceleration: Array | None = None,
    acceleration_variance: Array | float = 0.0,
    regressor: Array | None = None,
    *,
    is_turned: bool = False,
    prior: Array = FULL_CALIBRATION,
    noise: Array | None = None,
) -> Estimate:
    """Solve the poses: wrench (..., n, 6), N and Nm, and gravity (..., n, 3), in the sensor's frame, m/s².

    Also `acceleration` (..., n, 3), m/s², if gravity is from it, with `acceleration_variance` (...,) of its
    means by the sensor's noise, (m/s²)², of whose calibration `prior` is assumed; or `is_turned` to have the
    mounting found; and the `regressor` (..., n). `noise` (n, 6, 6): times what noise
    leaves of a pose, six independent numbers of variance 1. LinAlgError if an unknown is open.
    """
    if regressor is not None:  # of several regressors, each is a problem
        many = regressor.shape[:-1]
        wrench = np.broadcast_to(wrench, (*many, *wrench.shape[-2:]))
        gravity = np.broadcast_to(gravity, (*many, *gravity.shape[-2:]))
        acceleration = None if acceleration is None else np.broadcast_to(acceleration, gravity.shape)
    measured = np.swapaxes(wrench, -1, -2)
    calibration = mounting = shift = None
    excess = np.zeros(gravity.shape[:-1])
    if acceleration is None:
        if is_turned:
            gravity, solution = _mounted(gravity, measured, regressor)
        else:
            solution = _alone(gravity, measured, regressor)
    else:
        gravity, solution, excess = _with_accelerometer(
            measured, acceleration, gravity, acceleration_variance, regressor, prior, noise
        )
    answer, unknowns = solution.answer, solution.answer.shape[-1]
    mass = answer[..., :1]
    divisor = np.where(np.abs(mass) < _NOTHING, _NOTHING, mass)
    center = answer[..., 4:7] / divisor
    rows = np.broadcast_to(np.eye(unknowns), (*answer.shape[:-1], unknowns, unknowns)).copy()
    # The center is c / m: to first order.
    rows[..., 4:7, :] /= divisor[..., np.newaxis]
    rows[..., 4:7, 0] = -center / divisor
    deviation, degrees = solution.student(rows)
    half = students_t(degrees) * deviation
    wider = students_t(solution.student(np.broadcast_to(np.eye(unknowns), rows.shape))[1]) / NORMAL_95
    kept = [*range(10), *range(10 if regressor is None else 16, unknowns)]
    covariance = solution.covariance * wider[..., np.newaxis] * wider[..., np.newaxis, :]
    linear = 10
    if regressor is not None:
        linear = 16
        shift = Value(answer[..., 10:16], half[..., 10:16])
    if is_turned:
        mounting = Value(answer[..., linear:], half[..., linear:])
    if acceleration is not None:
        first, second, third = (
            slice(linear + begin, linear + end) for begin, end in ((0, 3), (3, 6), (6, 12))
        )
        calibration = (
            Value(answer[..., first], half[..., first]),
            Value(1.0 + answer[..., second], half[..., second]),
            Value(answer[..., third], half[..., third]),
        )
    return Estimate(
        Value(mass, half[..., :1]),
        Value(center, half[..., 4:7]),
        Value(answer[..., [1, 2, 3, 7, 8, 9]], half[..., [1, 2, 3, 7, 8, 9]]),
        calibration,
        mounting,
        shift,
        gravity,
        wrench - np.swapaxes(_times(_design(gravity, regressor), answer[..., :linear]), -1, -2),
        solution.degrees[..., :6],
        excess,
        answer[..., kept],
        covariance[..., kept, :][..., kept],
    )


def _alone(gravity: Array, measured: Array, regressor: Array | None, floor: float = _FLOOR_ALONE) -> Solution:
    """The unknowns of force and torque where gravity is known."""
    design = _design(gravity, regressor)
    unknowns = design.shape[-1]
    return solve(design, measured, Known(np.zeros((unknowns, unknowns)), np.full(6, floor**2)))


def _mounted(gravity: Array, measured: Array, regressor: Array | None) -> tuple[Array, Solution]:
    """Gravity and the unknowns of force and torque, those of the mounting last; by Gauss and Newton."""
    told, size = gravity, np.linalg.norm(gravity, axis=-1, keepdims=True)
    solution = _alone(told, measured, regressor)
    answer, linear = solution.answer, solution.answer.shape[-1]
    answer = np.concatenate([answer, np.zeros((*answer.shape[:-1], 3))], axis=-1)
    known = Known(np.diag([0.0] * linear + [_MOUNTING**-2] * 3), np.full(6, _FLOOR_ALONE**2))
    turn = np.cross(np.eye(3), told[..., np.newaxis, :])  # (..., n, 3 of the mounting, 3)
    turn = np.moveaxis(turn, -1, -3)  # (..., 3, n, 3 of the mounting)
    for _ in range(_LENGTH_ROUNDS):
        shown = _shown(answer, turn)
        target = measured + _times(shown, answer[..., linear:])
        solution = solve(np.concatenate([_design(gravity, regressor), shown], axis=-1), target, known)
        answer = solution.answer
        gravity = told + np.cross(answer[..., np.newaxis, linear:], told)
        gravity = gravity * size / np.linalg.norm(gravity, axis=-1, keepdims=True)
    return gravity, solution


def _shown(answer: Array, turn: Array) -> Array:
    """(..., 6, n, p): change of force and torque by what turns gravity by `turn` (..., 3, n, p)."""
    moment = np.cross(answer[..., 4:7, np.newaxis, np.newaxis], turn, axis=-3)
    return np.concatenate([answer[..., :1, np.newaxis, np.newaxis] * turn, moment], axis=-3)


class _Linear(NamedTuple):
    """The equations of the accelerometer about a calibration."""

    gravity: Array  # (..., n, 3)
    turn: Array  # (..., n, 3, 12): change of gravity by the calibration
    stretch: Array  # (..., 1, n, 12): change of the length of u
    excess: Array  # (..., 1, n): by how much gravity is longer than u


def corrected(acceleration: Array, calibration: Array) -> tuple[Array, Array]:
    """(..., n, 3) the truth of what was read, by `calibration` (..., 12), and (..., n, 3, 12) its change."""
    offset, scale = calibration[..., np.newaxis, :3], 1.0 + calibration[..., np.newaxis, 3:6]
    crossed = np.zeros((*calibration.shape[:-1], 3, 3))
    crossed[..., CROSS_ROW, CROSS_COLUMN] = calibration[..., 6:]
    straight = (np.eye(3) - crossed)[..., np.newaxis, :, :]
    v = (acceleration - offset) / scale
    u = (straight @ v[..., np.newaxis])[..., 0]
    change = np.zeros((*u.shape, _OF_CALIBRATION))
    change[..., :3] = -straight / scale[..., np.newaxis, :]
    change[..., 3:6] = -straight * (v / scale)[..., np.newaxis, :]
    change[..., CROSS_ROW, 6 + np.arange(6)] = -v[..., CROSS_COLUMN]
    return u, change


def _linearize(acceleration: Array, size: Array, calibration: Array) -> _Linear:
    """About `calibration` (..., 12). `size` (..., n) is the magnitude of gravity."""
    u, change = corrected(acceleration, calibration)
    length = np.linalg.norm(u, axis=-1)
    up = u / length[..., np.newaxis]
    along = (up[..., np.newaxis, :] @ change)[..., 0, :]
    across = change - up[..., np.newaxis] * along[..., np.newaxis, :]
    return _Linear(
        -size[..., np.newaxis] * up,
        -(size / length)[..., np.newaxis, np.newaxis] * across,
        along[..., np.newaxis, :, :],
        (size - length)[..., np.newaxis, :],
    )


def _with_accelerometer(
    measured: Array,
    acceleration: Array,
    gravity: Array,
    noise: Array | float,
    regressor: Array | None,
    prior: Array,
    explained: Array | None,
) -> tuple[Array, Solution, Array]:
    """Gravity (..., n, 3), the unknowns, those of the calibration last, and `excess`; by Gauss and Newton.

    The lengths alone come first: the errors of an uncorrected direction would pass for noise.
    """
    size = np.linalg.norm(gravity, axis=-1)
    assumed = np.zeros((*measured.shape[:-2], 7))
    assumed[..., 6] = _LENGTH_DEVIATION**2 + noise
    degrees = np.array([0.0] * 6 + [_LENGTH_DEGREES])
    if explained is not None:
        assumed[..., :6], degrees[:6] = 1.0, _NOISE_DEGREES
    lengths = Known(prior, _FLOOR[6:] ** 2, degrees[6:], assumed[..., 6:])
    calibration = np.zeros((*measured.shape[:-2], _OF_CALIBRATION))
    for _ in range(_LENGTH_ROUNDS):
        at = _linearize(acceleration, size, calibration)
        only = solve(at.stretch, at.excess + _times(at.stretch, calibration), lengths)
        calibration = only.answer
    at = _linearize(acceleration, size, calibration)
    first = _alone(at.gravity, measured, regressor, _FLOOR[3])
    linear = first.answer.shape[-1]
    answer = np.concatenate([first.answer, calibration], axis=-1)
    variances = np.concatenate([first.variances, only.variances], axis=-1)
    unknowns = answer.shape[-1]
    information = np.zeros((unknowns, unknowns))
    information[linear:, linear:] = prior
    least = _LEAST_SHARE * variances
    if explained is not None:
        least, variances[..., :6] = np.zeros(7), 1.0
    known = Known(information, np.maximum(least, _FLOOR**2), degrees, assumed)
    for _ in range(_ROUNDS):
        design = np.zeros((*measured.shape[:-2], 7, measured.shape[-1], unknowns))
        design[..., :6, :, :linear] = _design(at.gravity, regressor)
        turn = np.moveaxis(at.turn, -2, -3)
        design[..., :6, :, linear:] = _shown(answer, turn)
        design[..., 6:, :, linear:] = at.stretch
        # Gravity has the present calibration in it already, and the linear equations add it.
        twice = _times(design[..., linear:], answer[..., linear:])
        target = np.concatenate([measured, at.excess], axis=-2) + twice
        if explained is not None:
            design[..., :6, :, :] = np.einsum("nij,...jnp->...inp", explained, design[..., :6, :, :])
            target[..., :6, :] = np.einsum("nij,...jn->...in", explained, target[..., :6, :])
        solution = solve(design, target, known, variances)
        moved = np.abs(solution.answer - answer)[..., linear:].max()
        answer, variances = solution.answer, solution.variances
        at = _linearize(acceleration, size, answer[..., linear:])
        if moved <= _CONVERGED:
            break
    return at.gravity, solution, at.excess[..., 0, :]


def _times(design: Array, answer: Array) -> Array:
    """(..., k, n) of (..., k, n, p) and (..., p)."""
    return (design @ answer[..., np.newaxis, :, np.newaxis])[..., 0]


def _design(gravity: Array, regressor: Array | None = None) -> Array:
    """(..., 6, n, 10): m, bias force, c, bias torque, for each axis of force and torque; 16 with shifts."""
    unknowns = 10 if regressor is None else 16
    design = np.zeros((*gravity.shape[:-2], 6, gravity.shape[-2], unknowns))
    for axis, after, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        design[..., axis, :, 0] = gravity[..., axis]
        design[..., axis, :, 1 + axis] = 1.0
        design[..., 3 + axis, :, 4 + after] = gravity[..., last]
        design[..., 3 + axis, :, 4 + last] = -gravity[..., after]
        design[..., 3 + axis, :, 7 + axis] = 1.0
    if regressor is not None:
        for axis in range(6):
            design[..., axis, :, 10 + axis] = regressor
    return design
