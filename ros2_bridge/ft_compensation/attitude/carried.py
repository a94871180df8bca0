"""The attitude of the sensor in a frame that stands still, carried from sample to sample by the gyroscope.

The still frame is arbitrary: it begins as the sensor's, and `rotate` and `level` turn it. A unit quaternion
turns vectors of the sensor into it. In plain floats, because this runs for every sample.
"""

from __future__ import annotations

import math
from typing import Final

from ft_compensation.quantities import ZERO
from protocol.pdo import Vector3

Quaternion = tuple[float, float, float, float]
"""x, y, z, w"""
Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]
_IDENTITY: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)


class CarriedAttitude:
    """From one time to the next by the mean of the rates at both."""

    __slots__ = ("_rate", "matrix", "offset", "quaternion")

    def __init__(self) -> None:
        self.quaternion = _IDENTITY
        self.matrix: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        """Turns a vector of the sensor into the still frame."""
        self.offset: Vector3 = ZERO
        """What the gyroscope reads at rest, rad/s; subtracted."""
        self._rate: Vector3 | None = None

    def advance(self, rate: Vector3, passed_s: float) -> Vector3:
        """Turn by the angular rate (rad/s) for `passed_s`; returns the rotation vector, rad."""
        before, self._rate = self._rate or rate, rate
        ox, oy, oz = self.offset
        half_s = 0.5 * passed_s
        tx = (before[0] + rate[0] - 2.0 * ox) * half_s
        ty = (before[1] + rate[1] - 2.0 * oy) * half_s
        tz = (before[2] + rate[2] - 2.0 * oz) * half_s
        x, y, z, w = self.quaternion
        dx, dy, dz, dw = _small(tx, ty, tz)
        self._set(
            w * dx + x * dw + y * dz - z * dy,
            w * dy - x * dz + y * dw + z * dx,
            w * dz + x * dy - y * dx + z * dw,
            w * dw - x * dx - y * dy - z * dz,
        )
        return tx, ty, tz

    def rotate(self, turn: Vector3) -> None:
        """Turn the sensor by a rotation vector of the still frame, rad."""
        x, y, z, w = self.quaternion
        dx, dy, dz, dw = _small(*turn)
        self._set(
            dw * x + dx * w + dy * z - dz * y,
            dw * y - dx * z + dy * w + dz * x,
            dw * z + dx * y - dy * x + dz * w,
            dw * w - dx * x - dy * y - dz * z,
        )

    def ahead(self, seconds: float) -> Quaternion:
        """What the attitude is in `seconds` (negative: was), if the rate stays as it is."""
        other = CarriedAttitude()
        other.quaternion, other.offset = self.quaternion, self.offset
        if self._rate is not None:
            other.advance(self._rate, seconds)
        return other.quaternion

    def level(self, up: Vector3) -> None:
        """Turn the still frame so that `up`, a vector of the sensor of any length but zero, is its z axis."""
        x, y, z = up
        size = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / size, y / size, z / size
        if z < -0.999999:
            self._set(1.0, 0.0, 0.0, 0.0)
        else:
            w = math.sqrt(0.5 * (1.0 + z))
            self._set(0.5 * y / w, -0.5 * x / w, 0.0, w)

    def _set(self, x: float, y: float, z: float, w: float) -> None:
        # One Newton step keeps the length at 1.
        scale = 1.5 - 0.5 * (x * x + y * y + z * z + w * w)
        x, y, z, w = x * scale, y * scale, z * scale, w * scale
        self.quaternion = x, y, z, w
        self.matrix = matrix_of(x, y, z, w)


def matrix_of(x: float, y: float, z: float, w: float) -> Matrix:
    """The rotation matrix of a unit quaternion."""
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (
        (1.0 - yy - zz, xy - wz, xz + wy),
        (xy + wz, 1.0 - xx - zz, yz - wx),
        (xz - wy, yz + wx, 1.0 - xx - yy),
    )


def _small(tx: float, ty: float, tz: float) -> Quaternion:
    """A rotation vector as a quaternion: to fourth order where it is small."""
    quarter = 0.25 * (tx * tx + ty * ty + tz * tz)
    if quarter > 0.01:  # more than 0.2 rad
        half = math.sqrt(quarter)
        scale, w = 0.5 * math.sin(half) / half, math.cos(half)
    else:
        scale, w = 0.5 - quarter / 12.0, 1.0 - 0.5 * quarter + quarter * quarter / 24.0
    return tx * scale, ty * scale, tz * scale, w
