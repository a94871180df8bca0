# SPDX-License-Identifier: Apache-2.0
"""How wrong the compensated wrench may be: 95 % bounds of what is not contact, N and Nm, in plain floats.

The one place in Python; `Bounds` in compensation.hpp is its twin. The bound of force is for any pose; that of
torque for one sample, whose motion is known: an unknown inertia matters only while the tool spins. Both are
to be computed when they are shown, not for every sample.
"""

from __future__ import annotations

import math
from typing import Final

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.sensor.response import healthy_noise
from bota_ft_compensation.alignment import Alignment
from bota_ft_compensation.bias import TareBasis
from bota_ft_compensation.quantities import (
    NORMAL_95,
    STILL,
    Accelerometer,
    Payload,
    Turning,
    length,
    likely_inertia,
)

# From half of an interval of one axis to the radius that holds as often for three (chi, 3 degrees), ...
_ABOUT_THREE_AXES: Final = 2.80 / NORMAL_95
# ... and for three times the distance between the directions of gravity in two poses, which are any.
_BETWEEN_POSES: Final = 4.39 / NORMAL_95
IMU_BELOW: Final = 0.026  # m: how far the IMU is behind the wrench origin
_SHORTEST_SINC: Final = 51  # where the length is not known
_TYPED: Final = 0.1  # of its largest element: half of the interval of a tensor that is given without one


def force_bound_95(payload: Payload, accelerometer: Accelerometer, taken: TareBasis | None = None) -> float:
    """N: in 95 % of cases what is not known of the accelerometer shows as less force, in any pose.

    A bias `taken` by a tare that went by this accelerometer has the part of its offset in it, and what its
    scale and crossed axes did in that pose.
    """
    cross = accelerometer.cross_axis_interval
    largest = STANDARD_GRAVITY * max(*accelerometer.scale_interval, *cross)
    if taken is not None and taken.accelerometer == accelerometer:
        return payload.mass * _BETWEEN_POSES * largest
    per_axis = zip(
        accelerometer.offset_interval, accelerometer.scale_interval, cross[::2], cross[1::2], strict=True
    )
    halves = [math.hypot(offset, STANDARD_GRAVITY * max(parts)) for offset, *parts in per_axis]
    return payload.mass * _ABOUT_THREE_AXES * max(halves)


def torque_bound_95(
    payload: Payload,
    accelerometer: Accelerometer,
    taken: TareBasis | None = None,
    felt: Vector3 = (0.0, 0.0, STANDARD_GRAVITY),
    turning: Turning = STILL,
    noise: float = 0.0,
) -> float:
    """Nm, about the wrench origin: in 95 % of samples without contact less torque is left, in this motion.

    The root of the squares of four: the unknown inertia in this motion (`turning`, rad/s and rad/s²); the
    center of gravity's interval under the specific force `felt` there, m/s²; `force_bound_95` at its arm; and
    `noise`, Nm, of the sensor (`torque_noise_95`). `taken` as there. Components may be arrays of samples.
    """
    halves, (rate, spin) = inertia_halves(payload), turning
    sideways = sum(part * part for part in rate) ** 0.5 * _spread(halves, rate) ** 0.5
    off_center = off_center_95(payload, taken)
    at_arm = force_bound_95(payload, accelerometer, taken) * length(payload.center)
    squares = _spread(halves, spin) + 0.25 * sideways**2 + off_center**2 * sum(part * part for part in felt)
    bound: float = (squares + at_arm**2 + noise**2) ** 0.5
    return bound


def off_center_95(payload: Payload, taken: TareBasis | None = None) -> float:
    """kg m: what the center of gravity's interval makes of torque, for each m/s² of specific force."""
    is_tared = taken is not None and taken.specific_force != (0.0, 0.0, 0.0)
    factor = _BETWEEN_POSES if is_tared else _ABOUT_THREE_AXES
    return factor * payload.mass * max(payload.center_interval)


def torque_noise_95(payload: Payload, alignment: Alignment) -> float:
    """Nm: what the noise of a healthy sensor and its IMU keeps to in 95 % of samples."""
    reach, known = length(payload.center), alignment.settings
    felt, _ = alignment.noise(reach + IMU_BELOW)
    healthy = healthy_noise(int(known.get("sinc_length") or _SHORTEST_SINC), fir=bool(known.get("fir")))
    parts = max(healthy[3:]), payload.mass * reach * felt, inertia_noise(payload, alignment)
    return _ABOUT_THREE_AXES * NORMAL_95 * math.hypot(*parts)


def inertia_noise(payload: Payload, alignment: Alignment) -> float:
    """Nm: deviation on an axis that the tensor adds to what the noise of the specific force makes of torque.

    Both are of one gyroscope: the tensor's part adds to that of the lever, not to its square.
    """
    reach = length(payload.center)
    lever, spin = payload.mass * reach * (reach + IMU_BELOW), alignment.noise()[1]
    return spin * math.sqrt((lever + max(payload.inertia[:3])) ** 2 - lever**2)


def inertia_halves(payload: Payload) -> tuple[float, ...]:
    """kg m²: by how much each element of the tensor may be wrong; that of zeros is all of a likely one."""
    if any(payload.inertia_interval):
        return payload.inertia_interval
    if any(payload.inertia):
        return (_TYPED * max(payload.inertia),) * 6
    likely, half = likely_inertia(payload)
    return tuple(a + b for a, b in zip(likely, half, strict=True))


def _spread(halves: tuple[float, ...], turned: Vector3) -> float:
    """The square of what errors of the tensor's elements make of a vector, each as large as its half."""
    (xx, yy, zz, xy, xz, yz), (x, y, z) = (tuple(half * half for half in halves)), turned
    return (xx + xy + xz) * x * x + (xy + yy + yz) * y * y + (xz + yz + zz) * z * z
