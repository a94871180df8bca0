# SPDX-License-Identifier: Apache-2.0
"""The limits of rest, in one table: of tares in node and server, identification, and recordings."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StationaryLimits:
    """What counts as stationary.

    `..._deviation` is the standard deviation of any one axis, `..._drift` the drift of its mean.
    Bota's own test allows a healthy sensor 0.6 N and 0.014 Nm at SINC 51; at SINC 32 that is 0.8 N and
    0.02 Nm. A shorter filter or a noisy environment needs more.
    """

    force_deviation: float = 0.8  # N
    torque_deviation: float = 0.02  # Nm
    # N: how far the means of the quarters of the window may lie apart, beyond what noise explains.
    force_drift: float = 0.3
    torque_drift: float = 0.01  # Nm, likewise
    angular_rate: float = 0.05  # rad/s: length of the mean. A stationary gyroscope may read 0.03.
    angular_rate_deviation: float = 0.02  # rad/s
    # Of a gyroscope whose offset nobody has taken off, for the server, which knows no calibration.
    uncalibrated_angular_rate: float = 0.5  # rad/s
    acceleration_deviation: float = 0.3  # m/s²
    acceleration_drift: float = 0.05  # m/s²
    least_samples: int = 20

    @property
    def deviations(self) -> tuple[float, ...]:
        """By axis: of force, torque, acceleration, angular rate."""
        imu = self.acceleration_deviation, self.angular_rate_deviation
        return _by_axis(self.force_deviation, self.torque_deviation, *imu)

    @property
    def drifts(self) -> tuple[float, ...]:
        """By axis: of force, torque, acceleration."""
        return _by_axis(self.force_drift, self.torque_drift, self.acceleration_drift)


def _by_axis(*limits: float) -> tuple[float, ...]:
    return tuple(limit for limit in limits for _ in range(3))
