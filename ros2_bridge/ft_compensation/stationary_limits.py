"""What counts as stationary; without NumPy, for command lines."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StationaryLimits:
    """What counts as stationary.

    `..._spread` is the standard deviation of any one axis, `..._wander` the drift of its mean.
    Bota's own test allows a healthy sensor 0.6 N and 0.014 Nm at SINC 51; at SINC 32 that is 0.8 N and
    0.02 Nm. A shorter filter or a noisy environment needs more.
    """

    force_spread: float = 0.8  # N
    torque_spread: float = 0.02  # Nm
    # N: how far the means of the quarters of the window may lie apart, beyond what noise explains.
    force_wander: float = 0.3
    torque_wander: float = 0.01  # Nm, likewise
    angular_rate: float = 0.05  # rad/s: length of the mean. A stationary gyroscope may read 0.03.
    angular_rate_spread: float = 0.02  # rad/s
    acceleration_spread: float = 0.3  # m/s²
    acceleration_wander: float = 0.05  # m/s²
    least_samples: int = 20

    @property
    def spreads(self) -> tuple[float, ...]:
        """By axis: of force, torque, acceleration, angular rate."""
        each = self.force_spread, self.torque_spread, self.acceleration_spread, self.angular_rate_spread
        return tuple(limit for limit in each for _ in range(3))

    @property
    def wanders(self) -> tuple[float, ...]:
        """By axis: of force, torque, acceleration."""
        each = self.force_wander, self.torque_wander, self.acceleration_wander
        return tuple(limit for limit in each for _ in range(3))
