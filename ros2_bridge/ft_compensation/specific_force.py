"""The specific force at the tool's center of gravity: acceleration minus gravity.

An accelerometer measures it: at rest it reads minus gravity. The tool, held by the sensor, loads it with

    F = -m s,  M = r x F        s = a - g, at the center of gravity; r: the center of gravity

With an IMU elsewhere on the same rigid body, s = s_imu + alpha x d + omega x (omega x d), d from the IMU to
the center of gravity. Nobody needs to know where gravity points. Times are seconds on one clock.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from bota_ethercat.pdo import Vector3
from ft_compensation.quantities import EXACT, ZERO, Accelerometer

_SLOPE_S: Final = 0.005
"""Angular acceleration is the slope of the angular rate over this time, and so half of it late."""
_GAP_S: Final = 0.1
"""Samples further apart say nothing of the slope between them."""
_MOST: Final = 64


class ImuSpecificForce:
    """From the sensor's accelerometer and gyroscope, sample by sample."""

    def __init__(self, lever: Vector3 = ZERO, accelerometer: Accelerometer = EXACT) -> None:
        """`lever` is d, m; `accelerometer` corrects what it reads."""
        self.lever = lever
        self._correct = None if accelerometer[:2] == EXACT[:2] else accelerometer.correct
        self._rates: deque[tuple[float, Vector3]] = deque(maxlen=_MOST)

    def follow(self, acceleration: Vector3, angular_rate: Vector3, time_s: float) -> Vector3 | None:
        """m/s² at the center of gravity, of this sample (m/s², rad/s); None if it is not finite."""
        if self._correct is not None:
            acceleration = self._correct(acceleration)
        ax, ay, az = acceleration
        wx, wy, wz = angular_rate
        total = ax + ay + az + wx + wy + wz
        if total - total != 0.0:  # NaN or infinity
            self._rates.clear()
            return None
        dx, dy, dz = self.lever
        if not (dx or dy or dz):
            return acceleration
        tx, ty, tz = self._slope(angular_rate, time_s)
        vx, vy, vz = wy * dz - wz * dy, wz * dx - wx * dz, wx * dy - wy * dx
        return (
            ax + ty * dz - tz * dy + wy * vz - wz * vy,
            ay + tz * dx - tx * dz + wz * vx - wx * vz,
            az + tx * dy - ty * dx + wx * vy - wy * vx,
        )

    def _slope(self, rate: Vector3, time_s: float) -> Vector3:
        """Angular acceleration, rad/s²; zero until there are two samples."""
        rates = self._rates
        if rates and not 0.0 < time_s - rates[-1][0] <= _GAP_S:
            rates.clear()
        rates.append((time_s, rate))
        while len(rates) > 2 and time_s - rates[1][0] >= _SLOPE_S:
            rates.popleft()
        before_s, (x, y, z) = rates[0]
        passed_s = time_s - before_s
        if passed_s <= 0.0:
            return ZERO
        return (rate[0] - x) / passed_s, (rate[1] - y) / passed_s, (rate[2] - z) / passed_s
