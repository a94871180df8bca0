# SPDX-License-Identifier: Apache-2.0
"""Bias and tool subtracted from one sample, in plain floats: what runs for every sample.

Signs and units are those of docs/compensation.md. NumPy would cost more here than the arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

from bota_ethercat.pdo import Vector3
from bota_ft_compensation.quantities import (
    NO_PAYLOAD,
    NO_WRENCH,
    STILL,
    Payload,
    Turning,
    Wrench,
)


class Stages(NamedTuple):
    """One sample at every stage. `final` is `measured - bias - tool`."""

    bias: Wrench  # subtracted
    corrected: Wrench  # measured - bias
    tool: Wrench  # weight and inertia of the tool; subtracted
    final: Wrench  # the load of the environment on the sensor and its tool


class Compensator:
    """Payload and bias, subtracted from one sample after the other.

    Another thread may set `bias` while `compensate` runs: a sample sees the old one or the new.
    """

    def __init__(self, payload: Payload = NO_PAYLOAD, bias: Wrench = NO_WRENCH) -> None:
        self.payload, self.bias = payload, bias

    def compensate(
        self, force: Vector3, torque: Vector3, specific_force: Vector3, turning: Turning = STILL
    ) -> Stages:
        """Every stage of one sample: `force` (N) and `torque` (Nm, about the wrench origin) as measured.

        `specific_force` is that at the payload's center of gravity, in the sensor's frame, m/s²: acceleration
        minus gravity, as an accelerometer there would read. `turning` matters to what is no point mass.
        """
        bias = self.bias
        m, (cx, cy, cz), inertia, _, _ = self.payload
        (bfx, bfy, bfz), (bmx, bmy, bmz) = bias
        fx, fy, fz = force[0] - bfx, force[1] - bfy, force[2] - bfz
        mx, my, mz = torque[0] - bmx, torque[1] - bmy, torque[2] - bmz
        sx, sy, sz = specific_force
        tfx, tfy, tfz = -m * sx, -m * sy, -m * sz
        tmx, tmy, tmz = cy * tfz - cz * tfy, cz * tfx - cx * tfz, cx * tfy - cy * tfx
        if any(inertia):
            ix, iy, iz = _inertial_torque(inertia, turning)
            tmx, tmy, tmz = tmx - ix, tmy - iy, tmz - iz
        return Stages(
            bias,
            Wrench((fx, fy, fz), (mx, my, mz)),
            Wrench((tfx, tfy, tfz), (tmx, tmy, tmz)),
            Wrench((fx - tfx, fy - tfy, fz - tfz), (mx - tmx, my - tmy, mz - tmz)),
        )


def _inertial_torque(inertia: tuple[float, ...], turning: Turning) -> Vector3:
    """J alpha + omega x J omega, Nm: what it takes to turn a tool so."""
    xx, yy, zz, xy, xz, yz = inertia
    if len(turning) > 2:
        _, (ax, ay, az), (wxx, wyy, wzz), (wxy, wxz, wyz) = turning
    else:
        (wx, wy, wz), (ax, ay, az) = turning
        wxx, wyy, wzz, wxy, wxz, wyz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
    return (
        xx * ax + xy * ay + xz * az + xz * wxy - xy * wxz + yz * (wyy - wzz) + (zz - yy) * wyz,
        xy * ax + yy * ay + yz * az + xy * wyz - yz * wxy + xz * (wzz - wxx) + (xx - zz) * wxz,
        xz * ax + yz * ay + zz * az + yz * wxz - xz * wyz + xy * (wxx - wyy) + (yy - xx) * wxy,
    )
