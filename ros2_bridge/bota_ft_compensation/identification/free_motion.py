# SPDX-License-Identifier: Apache-2.0
"""Mass, center of gravity and bias from free motion alone, where no pose can be held.

About the wrench origin, with u the specific force there: force = bias - m u - arm h and torque = bias +
u x h - J (spun), with h = m times the center of gravity. This is linear but for what the accelerometer has of
offset, sensitivities and crossed axes, which enter u, and of which only what is typical is known before. Its
offset cannot be told from the bias so: the interval of the bias has it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ft_compensation.identification.estimation import (
    CROSS_COLUMN,
    CROSS_ROW,
    FULL_CALIBRATION,
    Value,
)
from bota_ft_compensation.identification.inertia import (
    Turned,
    crossing,
    divided,
    solve_pieces,
    untouched,
)
from bota_ft_compensation.identification.payload import (
    ARM,
    NEGLIGIBLE,
    Fit,
    Identified,
    accelerometer_of,
    check_center,
    check_mass,
    too_vague,
)
from bota_ft_compensation.identification.poses import Coverage
from bota_ft_compensation.identification.weighted import Array, students_t
from bota_ft_compensation.quantities import (
    ZERO,
    CompensationError,
    Payload,
    Wrench,
    length,
    likely_inertia,
)
from bota_ft_compensation.stationary import triple

_ROUNDS: Final = 8
_LIGHTEST: Final = 1e-3  # kg
_LEAST_FREE: Final = 0.6  # of the recording
_TYPICAL: Final = 2.0  # times the median of the residuals: more is no part of the first rounds
# kg, kg m, N, Nm, and a minute: so vague is what is known before that it says nothing.
_ANY: Final = [1e3] * 4
_ANY_BIAS: Final = [1e4] * 12
_CALIBRATION: Final = np.diag(FULL_CALIBRATION) ** -0.5
_UNKNOWNS: Final = 34  # mass, moment, tensor, bias and what it drifts a minute, calibration
_PARTS: Final = slice(22, 25), slice(25, 28), slice(28, 34)
_LEAST_PIECES: Final = 20  # of half a second
_MISFIT_N, _MISFIT_SHARE = 0.1, 0.01  # N, of the weight: rms that is no more free motion
_HEALTHY: Final = 5.0  # standard deviations that no accelerometer is beyond
_NEARLY_ALL: Final = 0.97
_MORE: Final = "turn the tool to and fro about each axis for 20 s, touching nothing"


def identify_in_motion(turned: Turned, imu: Vector3) -> Identified:
    """From what `turn` makes of an accelerometer that is not corrected, `imu` as there.

    CompensationError, one sentence, where the motion does not suffice or is not free.
    """
    read = turned.felt + turned.arm @ np.array(imu)
    errors = np.zeros((len(read), 3, 12))  # of what is felt, by offset, scale, crossed axes
    errors[:, range(3), range(3)] = 1.0
    errors[:, range(3), range(3, 6)] = read
    errors[:, CROSS_ROW, 6 + np.arange(6)] = read[:, CROSS_COLUMN]
    minutes, pieces, spun = divided(turned)
    still = np.broadcast_to(np.eye(6), (len(pieces), 6, 6))
    biases = np.concatenate([still, still * minutes], axis=2)
    wrench = np.concatenate([turned.force, turned.torque], axis=1)
    nothing = np.zeros_like(spun)
    is_free, answer = np.ones(len(read), bool), np.zeros(_UNKNOWNS)
    if len(np.unique(pieces[is_free])) < _LEAST_PIECES:
        raise CompensationError(f"at least 10 s of motion are needed: {_MORE}")
    for _ in range(_ROUNDS):
        mass, moment, calibration = answer[0], answer[1:4], answer[22:]
        felt = turned.felt - errors @ calibration
        shown = np.concatenate([mass * errors, crossing(moment[None]) @ errors], axis=1)
        of_mass = np.concatenate([-felt, nothing[:, :, 0]], axis=1)[:, :, None]
        of_moment = np.concatenate([-turned.arm, crossing(felt)], axis=1)
        of_tensor = np.concatenate([nothing, -spun], axis=1)
        design = np.concatenate([of_mass, of_moment, of_tensor, biases, shown], axis=2)
        target = wrench + shown @ calibration
        # What is known before: of the tensor, here about the wrench origin, not even its sign.
        payload = _payload(answer)
        about = np.array(likely_inertia(payload)[1]) + payload.mass * length(payload.center) ** 2
        deviations = np.concatenate([_ANY, about, _ANY_BIAS, _CALIBRATION])
        answer, covariance, degrees = solve_pieces(
            design[is_free], target[is_free], pieces[is_free], deviations**-2.0, np.zeros(_UNKNOWNS)
        )
        left = target - design @ answer
        beyond = np.linalg.norm(left[:, :3], axis=1)
        beyond[beyond < _TYPICAL * np.median(beyond[is_free])] = 0.0
        used, is_free = is_free, untouched(turned, beyond, abs(answer[0]) * STANDARD_GRAVITY)
    share = float(used.mean())
    rows = np.eye(_UNKNOWNS)
    rows[1:4] /= answer[0]  # the center is moment / mass: to first order
    rows[1:4, 0] = -answer[1:4] / answer[0] ** 2
    half = float(students_t(degrees)) * np.sqrt(np.einsum("qi,ij,qj->q", rows, covariance, rows))
    _check_free(answer, float(half[0]), left[used], share)
    check_mass(float(answer[0]), float(half[0]))
    payload = _payload(answer)._replace(center_interval=triple(half[1:4]))
    check_center(payload)
    if why := too_vague(payload, float(half[0]), STANDARD_GRAVITY):
        raise CompensationError(f"forces in motion {why}; {_MORE}")
    inertia, likely = likely_inertia(payload)
    weight = payload.mass * STANDARD_GRAVITY
    offset, scale, crossed = (Value(answer[part], half[part]) for part in _PARTS)
    accelerometer = accelerometer_of((offset, scale._replace(value=1.0 + scale.value), crossed))
    notes = [
        "the accelerometer's offset cannot be told from the bias in motion, and is in the interval of the "
        "bias: tare, or hold the tool in six poses, before gravity is taken from the robot's orientation"
    ]
    if share < _NEARLY_ALL:
        notes.append(
            f"something touched the tool in {100 * (1 - share):.0f} % of the time, which is left out"
        )
    return Identified(
        payload._replace(inertia=inertia, inertia_interval=likely),
        Wrench.of(answer[10:16].tolist()),
        STANDARD_GRAVITY,
        float(half[0]),
        Wrench.of(half[10:16].tolist()),
        (),
        Coverage(0, ZERO, None, _MORE),
        tuple(notes),
        _fit(left[used, :3], degrees, weight),
        _fit(left[used, 3:], degrees, weight * max(ARM, length(payload.center))),
        accelerometer,
    )


def _check_free(answer: Array, mass_interval: float, left: Array, share: float) -> None:
    """CompensationError if what is `left` (n, 6) of a `share` of the recording is not that of free motion."""
    if answer[0] < 0.0:
        check_mass(float(answer[0]), mass_interval)
    weight = float(answer[0]) * STANDARD_GRAVITY
    moment = max(ARM * weight, float(np.linalg.norm(answer[1:4])) * STANDARD_GRAVITY)
    force, torque = (float(np.sqrt((part**2).sum(axis=1).mean())) for part in np.split(left, 2, axis=1))
    if (
        share < _LEAST_FREE
        or force > _MISFIT_N + _MISFIT_SHARE * weight
        or torque > _MISFIT_N * ARM + _MISFIT_SHARE * moment
        or (np.abs(answer[22:]) > _HEALTHY * _CALIBRATION).any()
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
    return Payload(mass, triple(answer[1:4] / mass))
