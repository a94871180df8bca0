"""The signal `scene`: a tool hangs from a slowly turning wrist, and now and then it touches something.

Frames: the sensor's, with z out of the tool side; the world's, with z up. R(t) turns sensor vectors into
world vectors: yaw, pitch, roll about z, y', x''. All readings follow from R(t) and the wrist's acceleration
a(t): specific force f = R^T (a - g), so +1 g upward at rest; tool force F = m R^T (g - a) = -m f; torque
r x F. The tool's own rotational inertia and the lever arm to the IMU are left out: the wrist turns slowly.
"""

from __future__ import annotations

import math
import random

from ethercat_server.virtual_sensor.signals import Reading
from protocol.pdo import STANDARD_GRAVITY

Vector = tuple[float, float, float]

TOOL_MASS = 0.8
"""kg"""
TOOL_CENTRE: Vector = (0.004, -0.006, 0.055)
"""Centre of gravity in the sensor's frame, m."""
CONTACT_POINT: Vector = (0.0, 0.0, 0.12)
"""Where the tool touches things, m."""
CONTACT_PERIOD = 7.0
"""s from one contact to the next; the first begins 5 s after power-on."""
CONTACT_START, CONTACT_LENGTH = 5.0, 0.6
CONTACT_FORCE: Vector = (3.0, -2.0, -12.0)
"""At its peak, N, in the sensor's frame."""

# Amplitude (rad) and angular frequency (rad/s) of yaw, pitch and roll.
_YAW, _PITCH, _ROLL = (0.5, 0.31), (0.45, 0.23), (0.6, 0.37)
# Amplitude (m/s²) and angular frequency of the wrist's acceleration along each world axis.
_SHAKE = ((0.15, 1.7), (0.10, 2.3), (0.20, 1.1))

# Standard deviation at SINC 51, and the power with which it falls with the length: half of what Bota's
# own test allows at 51, and a little under half of it at 1024.
_REFERENCE_SINC = 51
_FORCE_NOISE, _FORCE_POWER = (0.3, 0.3, 0.3), 0.62
_TORQUE_NOISE, _TORQUE_POWER = (0.007, 0.007, 0.0025), 0.78
_ACCELERATION_NOISE = 0.002  # g
_ANGULAR_RATE_NOISE = 0.04  # °/s


def attitude(seconds: float) -> tuple[float, float, float]:
    """Yaw, pitch and roll, rad."""
    yaw, pitch, roll = (a * math.sin(w * seconds) for a, w in (_YAW, _PITCH, _ROLL))
    return yaw, pitch, roll


def quaternion(seconds: float) -> tuple[float, float, float, float]:
    """The attitude as x, y, z, w."""
    yaw, pitch, roll = (angle / 2 for angle in attitude(seconds))
    cy, sy, cp, sp, cr, sr = (
        math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
    )  # fmt: skip
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def angular_rate(seconds: float) -> Vector:
    """Angular velocity in the sensor's frame, rad/s: the derivative of the attitude."""
    _, pitch, roll = attitude(seconds)
    yaw_rate, pitch_rate, roll_rate = (a * w * math.cos(w * seconds) for a, w in (_YAW, _PITCH, _ROLL))
    return (
        roll_rate - yaw_rate * math.sin(pitch),
        pitch_rate * math.cos(roll) + yaw_rate * math.cos(pitch) * math.sin(roll),
        -pitch_rate * math.sin(roll) + yaw_rate * math.cos(pitch) * math.cos(roll),
    )


def to_sensor(seconds: float, vector: Vector) -> Vector:
    """A world vector in the sensor's frame: R^T times it."""
    yaw, pitch, roll = attitude(seconds)
    cy, sy, cp, sp, cr, sr = (
        math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
    )  # fmt: skip
    x, y, z = vector
    return (
        cy * cp * x + sy * cp * y - sp * z,
        (cy * sp * sr - sy * cr) * x + (sy * sp * sr + cy * cr) * y + cp * sr * z,
        (cy * sp * cr + sy * sr) * x + (sy * sp * cr - cy * sr) * y + cp * cr * z,
    )


def specific_force(seconds: float) -> Vector:
    """What an accelerometer at the sensor measures, m/s²."""
    ax, ay, az = (a * math.sin(w * seconds) for a, w in _SHAKE)
    return to_sensor(seconds, (ax, ay, az + STANDARD_GRAVITY))


def contact_force(seconds: float) -> Vector:
    """Force of the contact at `CONTACT_POINT`, N; zero most of the time."""
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
    """The signal `scene`; see `signals.Signal`."""

    exact = False

    def __init__(self, seed: int, noise: bool) -> None:
        self._gauss = random.Random(seed).gauss
        self._noise = noise
        self.set_sinc_length(_REFERENCE_SINC)

    def set_sinc_length(self, sinc_length: int) -> None:
        """A longer filter makes force and torque quieter."""
        ratio = sinc_length / _REFERENCE_SINC
        self._deviations = [s * ratio**-_FORCE_POWER for s in _FORCE_NOISE] + [
            s * ratio**-_TORQUE_POWER for s in _TORQUE_NOISE
        ]

    def reading(self, number: int, instant: int, seconds: float) -> Reading:  # noqa: ARG002
        """See `signals.Signal`."""
        fx, fy, fz = specific_force(seconds)
        weight = (-TOOL_MASS * fx, -TOOL_MASS * fy, -TOOL_MASS * fz)
        contact = contact_force(seconds)
        torque, contact_torque = cross(TOOL_CENTRE, weight), cross(CONTACT_POINT, contact)
        wx, wy, wz = angular_rate(seconds)
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
            quaternion(seconds),
        )
