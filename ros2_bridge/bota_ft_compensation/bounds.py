# SPDX-License-Identifier: Apache-2.0
"""How wrong the compensated wrench may be without contact: 95 % bounds of a sample, N and Nm.

In 95 % of samples the error of the force is less than its bound, and likewise that of the torque. A sample's
variance is the sum of four: the noise of force and torque, as measured or of a healthy sensor, with the
filters in force; the IMU's, times mass, lever and tensor; what is not known of tool and IMU, in this pose and
motion; and what alignment leaves of quick motion. The one place in Python; `Bounds` in compensation.hpp is
its twin. Plain floats, or arrays of samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.sensor.response import healthy_noise, imu_noise, noise_ratios
from bota_ethercat.settings import SettingValue
from bota_ft_compensation.alignment import Alignment
from bota_ft_compensation.bias import TareBasis
from bota_ft_compensation.quantities import (
    NORMAL_95,
    STILL,
    UNKNOWN_ACCURACY,
    UPRIGHT,
    ZERO,
    Accelerometer,
    Accuracy,
    Payload,
    Six,
    Turning,
    likely_inertia,
)

# Chi squared that 95 % keep to, by the sum of the variances: of the three axes of force, which are alike, and
# of torque, of which about two are.
_OF_FORCE, _OF_TORQUE = 7.815 / 3.0, 2.8
_TYPED: Final = 0.1  # of its largest element: half of the interval of a tensor that is given without one
# Of an IMU that is not identified: how far from its place, m, and how wrong its angular acceleration is; of
# any, what alignment leaves of that where FIR is off.
_OFF_PLACE, _SPIN, _ALIGNED = 1.3e-3, 0.013, 0.006
# Chi squared of two axes by that of three: errors of an IMU, or of a center of gravity, push along two.
_ALONE: Final = 1.15
_REFERENCE_SINC: Final = 51
_NO_TARE: Final = TareBasis()


def at_reference(noise: Iterable[float], settings: Mapping[str, SettingValue]) -> Six:
    """Deviations of samples with these settings, as `Accuracy.noise` has them."""
    a, b, c, d, e, f = (each / ratio for each, ratio in zip(noise, noise_ratios(settings), strict=True))
    return a, b, c, d, e, f


class Bounds:
    """Of samples with one tool, bias and filters. Variances are sums of three axes, N² and Nm².

    Attributes:
        noise: deviations of force and torque, N and Nm, of the sensor alone.
        imu: variances by the IMU's noise.
        unknown: variances of what is not known of tool and IMU, in any pose.
        by_felt: likewise for each (m/s²)² along each axis, of the specific force less that of the tare.
        by_spin: likewise for each (rad/s²)² about each axis.
    """

    def __init__(
        self, payload: Payload, accelerometer: Accelerometer | None, alignment: Alignment, lever: Vector3,
        taken: TareBasis | None = None, accuracy: Accuracy = UNKNOWN_ACCURACY,
    ) -> None:  # fmt: skip
        """`accelerometer`: None where gravity is not from it; `lever`: from the IMU to the center of gravity,
        m; `taken`: what the bias was taken with.
        """
        taken, by_imu = taken or _NO_TARE, float(accelerometer is not None)
        mass, center, tensor, center_halves, _ = payload
        known = taken.noise, accuracy.noise, healthy_noise(_REFERENCE_SINC), noise_ratios(alignment.settings)
        self.noise = [(a or b or healthy) * ratio for a, b, healthy, ratio in zip(*known, strict=True)]
        # What an angular acceleration about each axis makes of force and torque, squared.
        arm = mass * sum(c * d for c, d in zip(center, lever, strict=True))
        forces = [mass * mass * (_squared(lever) - d * d) for d in lever]
        torques = [
            sum(
                (arm * (i == j) - mass * d * center[i] + element) ** 2
                for j, (d, element) in enumerate(zip(lever, row, strict=True))
            )
            for i, row in enumerate(_matrix(tensor))
        ]
        at_arm, (felt, spin) = 2.0 / 3.0 * _squared(center), (each * each for each in alignment.noise())
        is_tared = taken.specific_force != ZERO
        if is_tared:  # with the mean of a second
            felt += imu_noise(alignment.settings)[0] ** 2 * alignment.period_s
        felt = 3.0 * mass * mass * felt
        self.imu = by_imu * (felt + sum(forces) * spin), by_imu * (at_arm * felt + sum(torques) * spin)
        self._fixed = self.imu[0] + _squared(self.noise[:3]), self.imu[1] + _squared(self.noise[3:])
        self._from = taken.specific_force if is_tared else ZERO
        is_same = is_tared and taken.accelerometer == accelerometer
        wrong = 0.0 if alignment.settings.get("fir") else _ALIGNED**2
        if any(accuracy.left):
            force, torque = ([3.0 * each * each for each in part] for part in _halved(accuracy.left))
            self.unknown = (0.0, 0.0) if is_same else (force[0], torque[0])
            self.by_felt = [force[1] * is_same] * 3, [torque[1] * is_same] * 3
            self.by_spin = [force[2]] * 3, [torque[2]] * 3
        else:
            weight, wrong = (mass / NORMAL_95) ** 2, wrong + _SPIN**2
            *offsets, x, y, z, xy, xz, yx, yz, zx, zy = (
                weight * half * half for half in _read_halves(accelerometer)
            )
            offset = 0.0 if is_same else sum(offsets)
            felts = [x + yx + zx, y + xy + zy, z + xz + yz]
            centers = [weight * half * half for half in center_halves]
            self.unknown = offset, at_arm * offset
            centers = [_ALONE * (sum(centers) - each) for each in centers]
            self.by_felt = felts, [c + at_arm * f for c, f in zip(centers, felts, strict=True)]
            wrong *= _ALONE
            off = [by_imu * (2.0 * _ALONE * (mass * _OFF_PLACE) ** 2 + each) for each in centers]
            halves = _matrix([(each / NORMAL_95) ** 2 for each in inertia_halves(payload)])
            self.by_spin = off, [sum(row) + at_arm * each for row, each in zip(halves, off, strict=True)]
        for row, whole in zip(self.by_spin, (forces, torques), strict=True):
            row[:] = (a + by_imu * wrong * b for a, b in zip(row, whole, strict=True))
        # What of the squares of a rest is noise of the gyroscope.
        self._still = -spin * sum(self.by_spin[0]), -spin * sum(self.by_spin[1])

    def at(self, felt: Any = UPRIGHT, turning: Turning = STILL) -> tuple[Any, Any]:
        """N and Nm, of a sample that felt this specific force at the center of gravity, m/s², and turned so.

        Components may be arrays of samples.
        """
        (x, y, z), ((wx, wy, wz), (ax, ay, az), *_) = felt, turning
        if self._from is None:  # unknown: on average
            x = y = z = STANDARD_GRAVITY * math.sqrt(2.0 / 3.0)
        else:
            fx, fy, fz = self._from
            x, y, z = x - fx, y - fy, z - fz
        x, y, z, wx, wy, wz = x * x, y * y, z * z, wx * wx, wy * wy, wz * wz
        quarter = 0.25 * (wx + wy + wz)  # what centripetal acceleration makes of the square
        ax, ay, az = ax * ax + quarter * wx, ay * ay + quarter * wy, az * az + quarter * wz
        (fx, fy, fz), (tx, ty, tz) = self.by_felt
        (px, py, pz), (qx, qy, qz) = self.by_spin
        p = self._still[0] + px * ax + py * ay + pz * az
        q = self._still[1] + qx * ax + qy * ay + qz * az
        force = self._fixed[0] + self.unknown[0] + fx * x + fy * y + fz * z + 0.5 * (p + abs(p))
        torque = self._fixed[1] + self.unknown[1] + tx * x + ty * y + tz * z + 0.5 * (q + abs(q))
        return (_OF_FORCE * force) ** 0.5, (_OF_TORQUE * torque) ** 0.5

    def of_tool(self) -> tuple[float, float, float]:
        """Deviations on each axis of what is not known: N, Nm, in any pose, and Nm for each rad/s²."""
        square = STANDARD_GRAVITY**2 * (1.0 if self._from == ZERO else 2.0) / 3.0
        force, torque = (
            math.sqrt((each + square * sum(row)) / 3.0)
            for each, row in zip(self.unknown, self.by_felt, strict=True)
        )
        return force, torque, math.sqrt(max(self.by_spin[1]) / 3.0)


def inertia_halves(payload: Payload) -> tuple[float, ...]:
    """kg m²: by how much each element of the tensor may be wrong; that of zeros is all of a likely one."""
    if any(payload.inertia_interval):
        return payload.inertia_interval
    if any(payload.inertia):
        return (_TYPED * max(payload.inertia),) * 6
    likely, half = likely_inertia(payload)
    return tuple(math.hypot(NORMAL_95 * a, b) for a, b in zip(likely, half, strict=True))


def _read_halves(accelerometer: Accelerometer | None) -> Sequence[float]:
    """Half of the intervals of offset, scale and crossed axes."""
    if accelerometer is None:
        return (0.0,) * 12
    _, _, offset, scale, _, crossed = accelerometer
    return *offset, *scale, *crossed


def _halved(six: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
    return six[:3], six[3:]


def _matrix(elements: Sequence[float]) -> tuple[Sequence[float], ...]:
    xx, yy, zz, xy, xz, yz = elements
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def _squared(vector: Iterable[float]) -> float:
    return sum(part * part for part in vector)
