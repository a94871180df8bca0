"""A wrench in another frame: rotated, and its torque about the other frame's origin. Plain floats.

Force and torque of one load, seen from frame B instead of S (R takes vectors of S to B, t is the origin of S
in B): f_B = R f_S, and m_B = R m_S + cross(t, f_B), because a force that acts at a distance has a torque.
Frames at rest to each other or not: this holds at each instant.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

from bota_ethercat.pdo import Vector3
from ft_compensation.quantities import ZERO, Quaternion, Wrench, unit_quaternion

Rotation = tuple[Vector3, Vector3, Vector3]
"""A rotation matrix, row by row."""
_IDENTITY: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class WrenchTransform(NamedTuple):
    """From a source frame to a target frame."""

    rotation: Rotation = _IDENTITY
    """Takes vectors of the source frame to the target frame."""
    translation: Vector3 = ZERO
    """The origin of the source frame in the target frame, m."""

    @classmethod
    def of(cls, translation: Vector3, quaternion: Quaternion) -> Self:
        """From the pose of the source frame in the target frame, as TF gives it. ValueError if it is none."""
        x, y, z, w = unit_quaternion(quaternion)
        if not math.isfinite(sum(translation)):
            raise ValueError("a translation is three finite numbers")
        rotation = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
            (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
            (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
        )
        return cls(rotation, translation)

    def inverse(self) -> Self:
        """From the target frame to the source frame."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        x, y, z = self.translation
        back = (a, d, g), (b, e, h), (c, f, i)
        return type(self)(
            back, (-a * x - d * y - g * z, -b * x - e * y - h * z, -c * x - f * y - i * z)
        )  # fmt: skip

    def apply(self, force: Vector3, torque: Vector3) -> Wrench:
        """The wrench in the target frame, its torque about that frame's origin."""
        (a, b, c), (d, e, f), (g, h, i) = self.rotation
        x, y, z = self.translation
        fx, fy, fz = force
        mx, my, mz = torque
        px, py, pz = a * fx + b * fy + c * fz, d * fx + e * fy + f * fz, g * fx + h * fy + i * fz
        return Wrench(
            (px, py, pz),
            (
                a * mx + b * my + c * mz + y * pz - z * py,
                d * mx + e * my + f * mz + z * px - x * pz,
                g * mx + h * my + i * mz + x * py - y * px,
            ),
        )
