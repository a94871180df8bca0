"""The physical signals: a tool on a moving wrist (see `motion`), with occasional contacts.

All readings follow from the attitude R(t) and the wrist's acceleration a(t): specific force f = R^T (a - g),
so +1 g upward when stationary; tool force F = m R^T (g - a) = -m f; torque r x F. The tool's own rotational
inertia and the lever arm to the IMU are neglected: the wrist turns slowly.
"""

from __future__ import annotations

import math
import random

from bota_ethercat.pdo import STANDARD_GRAVITY
from ethercat_server.virtual_sensor.measurement.motion import (
    Motion,
    Swaying,
    Vector,
    angular_rate,
    quaternion,
    to_sensor,
)
from ethercat_server.virtual_sensor.measurement.signals import Reading

TOOL_MASS = 0.8
"""kg"""
TOOL_CENTRE: Vector = (0.004, -0.006, 0.055)
"""Center of gravity in the sensor's frame, m."""
CONTACT_POINT: Vector = (0.0, 0.0, 0.12)
"""Point of contact on the tool, m."""
CONTACT_PERIOD = 7.0
"""s from one contact to the next; the first begins 5 s after power-on."""
CONTACT_START, CONTACT_LENGTH = 5.0, 0.6
CONTACT_FORCE: Vector = (3.0, -2.0, -12.0)
"""At its peak, N, in the sensor's frame."""

# Standard deviation at SINC 51, and the power with which it falls with the length: half of what Bota's
# own test allows at 51, and a little under half of it at 1024.
_REFERENCE_SINC = 51
_FORCE_NOISE, _FORCE_POWER = (0.3, 0.3, 0.3), 0.62
_TORQUE_NOISE, _TORQUE_POWER = (0.007, 0.007, 0.0025), 0.78
_ACCELERATION_NOISE = 0.002  # g
_ANGULAR_RATE_NOISE = 0.04  # °/s


def contact_force(seconds: float) -> Vector:
    """Force of the contact in `scene` at `CONTACT_POINT`, N; zero most of the time."""
    phase = (seconds - CONTACT_START) % CONTACT_PERIOD
    if seconds < CONTACT_START or phase >= CONTACT_LENGTH:
        return (0.0, 0.0, 0.0)
    push = math.sin(math.pi * phase / CONTACT_LENGTH) ** 2
    x, y, z = CONTACT_FORCE
    return x * push, y * push, z * push


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def temperature(seconds: float) -> float:
    """°C: drifts by 2 °C about 35 °C in ten minutes."""
    return 35.0 + 2.0 * math.sin(math.tau * seconds / 600.0)


class Scene:
    """A physical signal; see `signals.Signal`."""

    exact = False

    def __init__(self, seed: int, noise: bool, motion: Motion | None = None) -> None:
        """`motion` is that of the signal `scene` unless it is given."""
        self._motion = motion or Swaying()
        self._gauss = random.Random(seed).gauss
        self._noise = noise
        self.set_sinc_length(_REFERENCE_SINC)

    @property
    def deviations(self) -> tuple[float, ...]:
        """Standard deviation of the noise: force (N) and torque (Nm)."""
        return tuple(self._deviations)

    def set_sinc_length(self, sinc_length: int) -> None:
        """A longer filter makes force and torque quieter."""
        ratio = sinc_length / _REFERENCE_SINC
        self._deviations = [s * ratio**-_FORCE_POWER for s in _FORCE_NOISE] + [
            s * ratio**-_TORQUE_POWER for s in _TORQUE_NOISE
        ]

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `signals.Signal`."""
        attitude, rates = self._motion.attitude(seconds)
        ax, ay, az = self._motion.acceleration(seconds)
        fx, fy, fz = to_sensor(attitude, (ax, ay, az + STANDARD_GRAVITY))
        weight = (-TOOL_MASS * fx, -TOOL_MASS * fy, -TOOL_MASS * fz)
        contact = contact_force(seconds) if self._motion.touches else (0.0, 0.0, 0.0)
        torque, contact_torque = cross(TOOL_CENTRE, weight), cross(CONTACT_POINT, contact)
        wx, wy, wz = angular_rate(attitude, rates)
        load = [
            *(w + c for w, c in zip(weight, contact, strict=True)),
            *(w + c for w, c in zip(torque, contact_torque, strict=True)),
        ]
        imu = [
            fx / STANDARD_GRAVITY, fy / STANDARD_GRAVITY, fz / STANDARD_GRAVITY,
            math.degrees(wx), math.degrees(wy), math.degrees(wz),
        ]  # fmt: skip
        if self._noise:
            gauss = self._gauss
            load = [value + gauss(0.0, s) for value, s in zip(load, self._deviations, strict=True)]
            for axis in range(3):
                imu[axis] += gauss(0.0, _ACCELERATION_NOISE)
                imu[axis + 3] += gauss(0.0, _ANGULAR_RATE_NOISE)
        a, b, c, d, e, f = load
        return Reading(
            (a, b, c, d, e, f),
            (imu[0], imu[1], imu[2]),
            (imu[3], imu[4], imu[5]),
            temperature(seconds),
            quaternion(attitude),
        )
