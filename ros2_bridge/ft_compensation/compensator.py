"""Bias, weight and inertia subtracted from one sample, in plain floats: what runs for every sample.

Same signs and units as `equations`, which the tests hold it to. NumPy would cost more here than
the arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

from ft_compensation.quantities import EXACT, NO_PAYLOAD, NO_WRENCH, ZERO, Accelerometer, Payload, Wrench
from protocol.pdo import Vector3


class Stages(NamedTuple):
    """One sample at every stage. `final` is `measured - bias - gravity - inertia`."""

    bias: Wrench
    """Subtracted."""
    corrected: Wrench
    """measured - bias"""
    gravity: Wrench
    """The tool's weight; subtracted."""
    inertia: Wrench
    """The inertial term; subtracted. Zero unless it is switched on."""
    final: Wrench
    """The load of the environment on the sensor and its tool."""


class Compensator:
    """Payload and bias, subtracted from one sample after the other.

    `set_bias` may be called by another thread while `compensate` runs: a sample sees the old bias or the new.
    """

    def __init__(
        self,
        payload: Payload = NO_PAYLOAD,
        bias: Wrench = NO_WRENCH,
        *,
        inertia: bool = False,
        imu_position: Vector3 = ZERO,
        accelerometer: Accelerometer = EXACT,
    ) -> None:
        """`inertia` switches the inertial term on, which uses the last two.

        `imu_position` is the IMU's, m from the wrench origin, `accelerometer` corrects what it reads.
        """
        self.payload, self.bias = payload, bias
        self.inertia, self.imu_position, self.accelerometer = inertia, imu_position, accelerometer

    def set_bias(self, bias: Wrench) -> None:
        """From the next sample on this is subtracted."""
        self.bias = bias

    def compensate(
        self,
        force: Vector3,
        torque: Vector3,
        gravity: Vector3,
        acceleration: Vector3 = ZERO,
        angular_rate: Vector3 = ZERO,
    ) -> Stages:
        """Every stage of one sample.

        Args:
            force: measured, N.
            torque: measured, Nm.
            gravity: in the sensor's frame, m/s²: what a source in `orientation` gives.
            acceleration: measured (minus gravity at rest), m/s²; used by the inertial term only.
            angular_rate: measured, rad/s; used by the inertial term only.
        """
        bias = self.bias
        m, (cx, cy, cz) = self.payload
        (bfx, bfy, bfz), (bmx, bmy, bmz) = bias
        fx, fy, fz = force[0] - bfx, force[1] - bfy, force[2] - bfz
        mx, my, mz = torque[0] - bmx, torque[1] - bmy, torque[2] - bmz
        gx, gy, gz = gravity
        gfx, gfy, gfz = m * gx, m * gy, m * gz
        gmx, gmy, gmz = cy * gfz - cz * gfy, cz * gfx - cx * gfz, cx * gfy - cy * gfx
        corrected = Wrench((fx, fy, fz), (mx, my, mz))
        weight = Wrench((gfx, gfy, gfz), (gmx, gmy, gmz))
        left = Wrench((fx - gfx, fy - gfy, fz - gfz), (mx - gmx, my - gmy, mz - gmz))
        if not self.inertia:
            return Stages(bias, corrected, weight, NO_WRENCH, left)
        acceleration = self.accelerometer.correct(acceleration)
        wx, wy, wz = angular_rate
        ix, iy, iz = self.imu_position
        dx, dy, dz = cx - ix, cy - iy, cz - iz
        vx, vy, vz = wy * dz - wz * dy, wz * dx - wx * dz, wx * dy - wy * dx
        ifx = -m * (acceleration[0] + gx + wy * vz - wz * vy)
        ify = -m * (acceleration[1] + gy + wz * vx - wx * vz)
        ifz = -m * (acceleration[2] + gz + wx * vy - wy * vx)
        imx, imy, imz = cy * ifz - cz * ify, cz * ifx - cx * ifz, cx * ify - cy * ifx
        (fx, fy, fz), (mx, my, mz) = left
        final = Wrench((fx - ifx, fy - ify, fz - ifz), (mx - imx, my - imy, mz - imz))
        return Stages(bias, corrected, weight, Wrench((ifx, ify, ifz), (imx, imy, imz)), final)
