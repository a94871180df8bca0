# SPDX-License-Identifier: Apache-2.0
"""Mass, center of gravity, tensor and bias from free motion: alone, or beside poses.

About the wrench origin, with u the specific force there: force = bias - m u - arm h and torque = bias +
u x h - J (spun), with h = m times the center of gravity. This is linear but for the IMU: what its
accelerometer has of offset, sensitivities and crossed axes, its gyroscope likewise, and how far it is from
its place. Of these what is typical is known before, the chip as a whole may be turned, and poses know more.
What the motion does not show of them remains in the covariance, and so in the intervals of all others.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ft_compensation.identification.estimation import (
    CHIP_TURN,
    FULL_CALIBRATION,
    OF_TURN,
    Value,
    corrected,
)
from bota_ft_compensation.identification.inertia import (
    Turned,
    divided,
    possible_inertia,
    solve_pieces,
    untouched,
)
from bota_ft_compensation.identification.payload import (
    ARM,
    NEGLIGIBLE,
    Fit,
    Identified,
    Joint,
    accelerometer_of,
    check_center,
    check_mass,
    too_vague,
)
from bota_ft_compensation.identification.poses import Coverage
from bota_ft_compensation.identification.weighted import Array, students_t
from bota_ft_compensation.quantities import (
    NO_WRENCH,
    NORMAL_95,
    ZERO,
    CompensationError,
    Payload,
    Six,
    Wrench,
    length,
    likely_inertia,
)
from bota_ft_compensation.stationary import triple
from bota_ft_compensation.turning import PLACES, crossing, on_places, on_tensors

_ROUNDS: Final = 8
_LIGHTEST: Final = 1e-3  # kg
_SPUN: Final = 10.0  # rad/s²: any that is more than noise
_LEAST_FREE: Final = 0.6  # of the recording
_TYPICAL: Final = 2.0  # times the median of the residuals: more is no part of the first rounds
# Unknowns: mass, moment, tensor about the origin, bias and what it drifts a minute; of the IMU accelerometer,
# gyroscope (what to subtract of the rates, row by row) and place; and the bias in the poses.
_MOMENT, _TENSOR, _BIAS, _READ = slice(1, 4), slice(4, 10), slice(10, 16), slice(22, 34)
_GYROSCOPE, _PLACE, _IN_POSES, _UNKNOWNS = slice(34, 43), slice(43, 46), slice(46, 52), 52
_OF_IMU: Final = slice(22, 46)
_OF_POSES: Final = [0, *range(46, 49), *range(1, 4), *range(49, 52), *range(22, 34)]  # as `Joint` has them
# kg, kg m, N, Nm, and a minute: so vague is what is known before that it says nothing.
_ANY: Final = 1e3
# Standard deviations of a gyroscope's sensitivity and crossed axes, and of the IMU's place, m: nobody
# publishes them; docs/compensation.md.
_GAIN, _CROSSED, _OFF_PLACE = 0.01, 0.006, 1.3e-3
_LEAST_PIECES, _FEW_PIECES = 20, 5  # of half a second; beside poses
_MISFIT_N, _MISFIT_SHARE = 0.1, 0.01  # N, of the weight: rms that is no more free motion
_HEALTHY: Final = 4.0  # standard deviations, in the mean, that nothing that was known is off by
_HARDLY: Final = 0.5  # of the interval before: a moment no better known than so is not determined
_NEARLY_ALL: Final = 0.97
_PARTS: Final = slice(0, 3), slice(3, 6), slice(6, 12)
_NO_OFFSET: Final = (
    "the accelerometer's offset cannot be told from the bias in motion, and is in the interval of the "
    "bias: tare, or hold the tool in six poses, before gravity is taken from the robot's orientation"
)
_MORE: Final = "turn the tool to and fro about each axis for 20 s, touching nothing"


def _imu_covariance() -> Array:
    """(24, 24), of what is known of any IMU."""
    turned, gyroscope = np.zeros((24, 3)), np.full((3, 3), _CROSSED)
    np.fill_diagonal(gyroscope, _GAIN)
    turned[6:12] = CHIP_TURN * OF_TURN
    turned[12:21].reshape(3, 3, 3)[~np.eye(3, dtype=bool)] = CHIP_TURN * OF_TURN
    found = np.diag([*[0.0] * 12, *gyroscope.ravel() ** 2, *[_OFF_PLACE**2] * 3]) + turned @ turned.T
    found[:12, :12] = np.linalg.inv(FULL_CALIBRATION)
    return np.asarray(found)


_IMU: Final = np.linalg.inv(_imu_covariance())


class _Model:
    """What motion makes of the unknowns."""

    def __init__(self, turned: Turned, imu: Vector3) -> None:
        self._imu = np.array(imu)
        self._spin, self._products = turned.spin, turned.products
        self._read = turned.felt + on_places(self._spin, self._products) @ self._imu
        # `_shown` (n, 6), of the tensor's elements: more than noise shows them.
        minutes, self.pieces, self._shown = divided(turned)
        still = np.broadcast_to(np.eye(6), (len(minutes), 6, 6))
        self._bias = np.concatenate([still, still * minutes], axis=2)

    @property
    def is_spun(self) -> NDArray[np.bool_]:
        """(n,): whether it turns."""
        return np.asarray(self._shown.any(axis=1))

    def at(self, unknowns: Array) -> tuple[Array, Array]:
        """(n, 6, 52) and (n, 6): the design about these unknowns, and what it would explain of nothing."""
        mass, moment, tensor = unknowns[0], unknowns[_MOMENT], unknowns[_TENSOR]
        right = np.eye(3) - unknowns[_GYROSCOPE].reshape(3, 3)
        spin, products = self._spin @ right.T, right @ self._products @ right.T
        place = self._imu + unknowns[_PLACE]
        arm, spun = on_places(spin, products), on_tensors(spin, products)
        felt, by_read = corrected(self._read, unknowns[_READ])
        felt = felt - (arm @ place)
        by_place = np.zeros((len(felt), 6, 3))
        by_gyroscope = np.zeros((len(felt), 6, 9))
        for number in range(9):
            row, column = divmod(number, 3)
            less = np.zeros((3, 3))
            less[row, column] = -1.0
            of_products = less @ self._products @ right.T
            changes = self._spin @ less.T, of_products + of_products.transpose(0, 2, 1)
            change, spun_change = on_places(*changes), on_tensors(*changes)
            moved = -change @ place
            by_gyroscope[:, :3, number] = -mass * moved - change @ moment
            by_gyroscope[:, 3:, number] = np.cross(moved, moment) - spun_change @ tensor
        by_place[:, :3], by_place[:, 3:] = mass * arm, crossing(moment[None]) @ arm
        of_imu = np.concatenate([-mass * by_read, -crossing(moment[None]) @ by_read], axis=1)
        of_imu = np.concatenate([of_imu, by_gyroscope, by_place], axis=2)
        nothing, spun = np.zeros_like(spun), spun * self._shown[:, None, :]
        of_mass = np.concatenate([-felt, nothing[:, :, 0]], axis=1)[:, :, None]
        of_moment = np.concatenate([-arm, crossing(felt)], axis=1)
        of_tensor = np.concatenate([nothing, -spun], axis=1)
        rows = [of_mass, of_moment, of_tensor, self._bias, of_imu, np.zeros((len(felt), 6, 6))]
        return np.concatenate(rows, axis=2), of_imu @ unknowns[_OF_IMU]


class _Answer(NamedTuple):
    unknowns: Array  # (52,)
    covariance: Array  # (52, 52)
    degrees: float  # of freedom
    left: Array  # (n, 6), of what was free, N and Nm
    share: float  # of the recording, that was free


def identify_in_motion(turned: Turned, imu: Vector3, poses: Identified | None = None) -> Identified:
    """From what `turn` makes of an accelerometer that is not corrected, `imu` as there, and of `poses`.

    CompensationError, one sentence, where the motion does not suffice or is not free.
    """
    joint = poses.joint if poses else None
    found = _solved(turned, _Model(turned, imu), joint)
    unknowns, covariance = found.unknowns, _together(found.unknowns, found.covariance)
    half = float(students_t(found.degrees)) * np.sqrt(np.diag(covariance))
    weight, mass_interval = float(unknowns[0]) * STANDARD_GRAVITY, float(half[0])
    check_mass(float(unknowns[0]), mass_interval)
    payload = _payload(unknowns)._replace(center_interval=triple(half[_MOMENT]))
    check_center(payload)
    if why := too_vague(payload, mass_interval, STANDARD_GRAVITY):
        raise CompensationError(f"forces in motion {why}; {_MORE}")
    before = np.array(likely_inertia(payload)[1])
    interval = np.minimum(half[_TENSOR], before)
    vague = "".join(
        axis for axis, is_open in zip("xyz", interval > _HARDLY * before, strict=False) if is_open
    )
    inertia = possible_inertia(unknowns[_TENSOR] - _steiner(unknowns)[0], interval)
    offset, scale, crossed = (Value(unknowns[_READ][part], half[_READ][part]) for part in _PARTS)
    bias = _IN_POSES if joint else _BIAS
    notes = [*([_hardly(vague)] if vague else []), *(poses.notes if poses else [_NO_OFFSET])]
    if found.share < _NEARLY_ALL and not joint:
        notes.append(
            f"something touched the tool in {100 * (1 - found.share):.0f} % of the time, which is left out"
        )
    force_fit, torque_fit = (
        _fit(left, found.degrees, each)
        for left, each in zip(
            np.split(found.left, 2, axis=1), (weight, weight * max(ARM, length(payload.center))), strict=True
        )
    )
    seen = Coverage(0, ZERO, None, _MORE)
    result = poses or Identified(
        payload, NO_WRENCH, STANDARD_GRAVITY, mass_interval, NO_WRENCH, (), seen, (), force_fit, torque_fit,
        None, noise=_noise(turned, found, payload),
    )  # fmt: skip
    return result._replace(
        payload=payload._replace(inertia=tuple(inertia.tolist()), inertia_interval=tuple(interval.tolist())),
        bias=Wrench.of(unknowns[bias].tolist()),
        bias_interval=Wrench.of(half[bias].tolist()),
        mass_interval=mass_interval,
        accelerometer=accelerometer_of((offset, scale._replace(value=1.0 + scale.value), crossed)),
        notes=tuple(notes),
        left=_left(found, imu, bias),
        gyroscope=tuple((np.eye(3).ravel() - unknowns[_GYROSCOPE]).tolist()),
        imu=triple(np.add(imu, unknowns[_PLACE])),
    )


def _solved(turned: Turned, model: _Model, joint: Joint | None) -> _Answer:
    """CompensationError where the motion does not suffice or is not free."""
    wrench = np.concatenate([turned.force, turned.torque], axis=1)
    known, towards, answer = _known(joint)
    is_free, may_be, least = np.ones(len(wrench), bool), np.ones(len(wrench), bool), _LEAST_PIECES
    if joint is not None:
        least, may_be = _FEW_PIECES, model.is_spun  # the poses tell of the rest
        design, explained = model.at(answer)
        beyond = np.linalg.norm((wrench + explained - design @ answer)[:, :3], axis=1)
        is_free = untouched(turned, beyond, answer[0] * STANDARD_GRAVITY)
    if len(np.unique(model.pieces[is_free])) < least:
        raise CompensationError(
            "something touched the tool all the time between the poses"
            if joint
            else f"at least 10 s of motion are needed: {_MORE}"
        )
    if len(np.unique(model.pieces[is_free & may_be])) < least:
        raise CompensationError(_hardly("xyz"))
    is_free &= may_be
    for _ in range(_ROUNDS):
        design, explained = model.at(answer)
        # What is known before of the tensor, here about the wrench origin.
        likely, half = map(np.array, likely_inertia(_payload(answer)))
        information = (NORMAL_95 / half) ** 2
        known[_TENSOR, _TENSOR] = np.diag(information)
        towards[_TENSOR] = information * (likely + _steiner(answer)[0])
        answer, covariance, degrees = solve_pieces(
            design[is_free], (wrench + explained)[is_free], model.pieces[is_free], known, towards
        )
        left = wrench + explained - design @ answer
        beyond = np.linalg.norm(left[:, :3], axis=1)
        beyond[beyond < _TYPICAL * np.median(beyond[is_free])] = 0.0
        used, is_free = is_free, untouched(turned, beyond, abs(answer[0]) * STANDARD_GRAVITY) & may_be
        if len(np.unique(model.pieces[is_free])) < least:
            break
    found = _Answer(answer, covariance, degrees, left[used], 1.0 if joint else float(used.mean()))
    _check_free(found, known, towards)
    return found


def _noise(turned: Turned, found: _Answer, payload: Payload) -> tuple[float, ...]:
    """Deviations of single samples, by what is left of smoothed ones: in which the IMU's noise is, too."""
    squares = (found.left**2).mean(axis=0)
    by_imu = (payload.mass * turned.imu_noise) ** 2
    x, y, z = (part * part for part in payload.center)
    arms = np.array([1.0, 1.0, 1.0, y + z, x + z, x + y])
    return tuple((turned.noisier * np.sqrt(np.maximum(squares - by_imu * arms, 0.1 * squares))).tolist())


def _left(found: _Answer, imu: Vector3, bias: slice) -> Six:
    """As `Accuracy.left`, by the covariance."""
    axes = np.eye(3)
    felt = np.concatenate([STANDARD_GRAVITY * axes, -STANDARD_GRAVITY * axes, np.zeros((4, 3))])
    spin = np.concatenate([np.zeros((6, 3)), _SPUN * axes, np.zeros((1, 3))])
    products = np.zeros((10, 3, 3))
    felt -= on_places(spin, products) @ (found.unknowns[_MOMENT] / found.unknowns[0])
    nothing = np.zeros((10, 3))
    model = _Model(Turned(nothing, nothing, felt, spin, products, np.arange(10.0)), imu)
    rows = model.at(found.unknowns)[0]
    of_bias = rows[..., _BIAS].copy()
    rows[..., 10:22] = 0.0
    rows[..., bias] = of_bias

    def deviations(each: Array, per: Array | float) -> list[float]:
        variances = np.einsum("nkp,pq,nkq->nk", each, found.covariance, each) / np.square(per)
        return [math.sqrt(float(part.mean())) for part in np.split(variances, 2, axis=1)]

    first, second = np.array([(i, j) for i in range(6) for j in range(i)]).T
    apart = np.linalg.norm(felt[first] - felt[second], axis=1)[:, None]
    parts = (
        deviations(rows[:6], 1.0),
        deviations(rows[first] - rows[second], apart),
        deviations(rows[6:9] - rows[9], _SPUN),
    )
    (a, d), (b, e), (c, f) = parts
    return a, b, c, d, e, f


def _hardly(axes: str) -> str:
    return (
        f"the tool hardly turned about {' and '.join(axes)}, so its inertia there is only what mass and "
        "center of gravity make likely: turn it to and fro about each axis for some seconds, touching nothing"
    )


def _known(joint: Joint | None) -> tuple[Array, Array, Array]:
    """(52, 52) information that is known before, (52,) times what is expected, and where to begin."""
    known, towards, answer = np.eye(_UNKNOWNS) * _ANY**-2, np.zeros(_UNKNOWNS), np.zeros(_UNKNOWNS)
    known[_OF_IMU, _OF_IMU] = _IMU
    if joint is not None:
        information = np.linalg.inv(joint.covariance)
        known[_READ, _READ] -= FULL_CALIBRATION  # the poses have it in them
        known[np.ix_(_OF_POSES, _OF_POSES)] += information
        towards[_OF_POSES], answer[_OF_POSES] = information @ joint.unknowns, joint.unknowns
        answer[_BIAS] = answer[_IN_POSES]
    return known, towards, answer


def _steiner(answer: Array) -> tuple[Array, Array]:
    """(6,): by how much the tensor about the origin is larger, and (6, 4) its change by mass and moment."""
    mass, moment = max(float(answer[0]), _LIGHTEST), answer[_MOMENT]
    rows, columns = np.array(PLACES).T
    more = np.eye(3) * (moment @ moment) - np.outer(moment, moment)
    by_moment = 2 * np.eye(3)[..., None] * moment - np.eye(3)[:, None] * moment[:, None]
    by_moment = by_moment - moment[:, None, None] * np.eye(3)[None]
    return more[rows, columns] / mass, np.concatenate(
        [-more[rows, columns, None] / mass**2, by_moment[rows, columns] / mass], axis=1
    )


def _together(answer: Array, covariance: Array) -> Array:
    """The covariance with the center in place of the moment, and the tensor about it."""
    rows = np.eye(_UNKNOWNS)
    rows[_MOMENT] /= answer[0]  # the center is moment / mass: to first order
    rows[_MOMENT, 0] = -answer[_MOMENT] / answer[0] ** 2
    rows[_TENSOR, :4] = -_steiner(answer)[1]
    return np.asarray(rows @ covariance @ rows.T)


def _check_free(found: _Answer, known: Array, towards: Array) -> None:
    """CompensationError if what is left is not that of free motion."""
    answer, share = found.unknowns, found.share
    if answer[0] < 0.0:
        check_mass(float(answer[0]), float(students_t(found.degrees)) * math.sqrt(found.covariance[0, 0]))
    weight = float(answer[0]) * STANDARD_GRAVITY
    moment = max(ARM * weight, float(np.linalg.norm(answer[_MOMENT])) * STANDARD_GRAVITY)
    force, torque = (float(np.sqrt((part**2).sum(axis=1).mean())) for part in np.split(found.left, 2, axis=1))
    off = answer - np.linalg.solve(known, towards)
    beyond = math.sqrt(float(off[_OF_IMU] @ known[_OF_IMU, _OF_IMU] @ off[_OF_IMU]) / 24)
    if (
        share < _LEAST_FREE
        or force > _MISFIT_N + _MISFIT_SHARE * weight
        or torque > _MISFIT_N * ARM + _MISFIT_SHARE * moment
        or beyond > _HEALTHY
    ):
        raise CompensationError(
            f"force and torque, off by {force:.2g} N and {torque:.2g} Nm, and in {100 * (1 - share):.0f} % "
            "of the recording by more, are not those of a tool that moves freely: something touched, held or "
            "pulled it, or an axis has another sign or unit"
        )


def _fit(residuals: Array, degrees: float, weight: float) -> Fit:
    rms = float(np.sqrt((residuals**2).mean()))
    return Fit(rms, degrees, None, "small" if rms <= NEGLIGIBLE * weight else "large")


def _payload(answer: Array) -> Payload:
    mass = max(float(answer[0]), _LIGHTEST)
    return Payload(mass, triple(answer[_MOMENT] / mass))
