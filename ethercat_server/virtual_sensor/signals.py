"""What there is to measure without an outside world: formulas of the sample number, or a tool on a wrist.

Frames: the sensor's, with z out of the tool side; the world's, with z up. An attitude is yaw, pitch and roll
(rad) about z, y', x''; it turns sensor vectors into world vectors. Documented in docs/virtual-sensor.md.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from bota_ethercat.pdo import STANDARD_GRAVITY, Vector3
from bota_ethercat.sensor.frames import IMU_HEIGHTS
from bota_ethercat.world import Felt

# As the fields of the process data are named, in their order.
CHANNELS: Final[tuple[str, ...]] = tuple(
    f"{vector}.{axis}" for vector in ("force", "torque", "acceleration", "angular_rate") for axis in "xyz"
)
World = Callable[[float], Felt]  # of the time since power-on, s, or of CLOCK_MONOTONIC if it is external


class PhysicalSample(NamedTuple):
    """One sample before settings act on it, in the units of the process data."""

    # As `CHANNELS`: N, Nm; specific force, g, +1 along the axis that points up, if stationary; °/s.
    values: Sequence[float]
    temperature: float  # °C
    orientation: tuple[float, ...]  # x, y, z, w: turns vectors of the sensor's frame into the world's


CONSTANT: Final = (1.5, -2.25, -9.75, 0.125, -0.0625, 0.03125)  # exact in REAL32


@dataclass(frozen=True)
class Formula:
    """A signal that is a function of sample number and instant; level and stationary."""

    load: Callable[[int, int], Iterable[float]]
    temperature: Callable[[int], float] = lambda _: 35.0
    is_exact: bool = False  # noise would make its numbers unreadable

    def reading(self, number: int, instant: int, seconds: float) -> PhysicalSample:  # noqa: ARG002
        values = *self.load(number, instant), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        return PhysicalSample(values, self.temperature(number), (0.0, 0.0, 0.0, 1.0))


def _clock(number: int, instant: int) -> Iterable[float]:
    """Every sample carries its own number and its instant.

    force.x is the number modulo 2**24; force.y whole seconds modulo 2**20, force.z
    microseconds and torque.x the remaining nanoseconds. All are exact in REAL32.
    """
    whole, rest = divmod(instant, 10**9)
    micros, nanos = divmod(rest, 1000)
    return float(number % 2**24), float(whole % 2**20), float(micros), float(nanos), 0.0, 0.0


FORMULAS: Final = {
    "clock": Formula(_clock, is_exact=True),
    "constant": Formula(lambda *_: CONSTANT),
    # The sample number in the temperature: steps of 2**-18 °C, from 32 to 48 °C, are exact in REAL32.
    "rest": Formula(lambda *_: CONSTANT, lambda k: 32 + k % 2**22 / 2**18),
}


def cross(a: Vector3, b: Vector3) -> Vector3:
    """The vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _cosines_and_sines(angles: Vector3) -> tuple[float, float, float, float, float, float]:
    yaw, pitch, roll = angles
    cos, sin = math.cos, math.sin
    return cos(yaw), sin(yaw), cos(pitch), sin(pitch), cos(roll), sin(roll)


def quaternion(attitude: Vector3) -> tuple[float, ...]:
    """The attitude as x, y, z, w."""
    cy, sy, cp, sp, cr, sr = _cosines_and_sines((attitude[0] / 2, attitude[1] / 2, attitude[2] / 2))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


# Amplitude (rad) and angular frequency (rad/s) of yaw, pitch and roll.
_SWINGS = ((0.5, 0.31), (0.45, 0.23), (0.6, 0.37))
# Amplitude (m/s²) and angular frequency of the wrist's acceleration along each world axis.
_SHAKE = ((0.15, 1.7), (0.10, 2.3), (0.20, 1.1))
TOOL_MASS = 0.8  # kg
TOOL_CENTRE: Vector3 = (0.004, -0.006, 0.055)  # center of gravity in the sensor's frame, m
TOOL_INERTIA = (0.0022, 0.002, 0.0009, 0.0001, -0.0002, 0.0001)  # xx yy zz xy xz yz about it, kg m²
_IMU: Final[Vector3] = (0.0, 0.0, IMU_HEIGHTS["SENS"])  # m
CONTACT_POINT: Vector3 = (0.0, 0.0, 0.12)  # on the tool, m
CONTACT_START, CONTACT_LENGTH, CONTACT_PERIOD = 5.0, 0.6, 7.0  # s: of the first; from one to the next
CONTACT_FORCE: Vector3 = (3.0, -2.0, -12.0)  # at its peak, N, in the sensor's frame


Angles = tuple[Vector3, Vector3, Vector3]  # yaw, pitch and roll, rad, and their first and second derivatives


def sway(seconds: float) -> Angles:
    """Never stationary: yaw, pitch and roll swing."""
    yaw, pitch, roll = (a * math.sin(w * seconds) for a, w in _SWINGS)
    yaw_rate, pitch_rate, roll_rate = (a * w * math.cos(w * seconds) for a, w in _SWINGS)
    yaw_spin, pitch_spin, roll_spin = (-w * w * a * math.sin(w * seconds) for a, w in _SWINGS)
    return (yaw, pitch, roll), (yaw_rate, pitch_rate, roll_rate), (yaw_spin, pitch_spin, roll_spin)


def contact_force(seconds: float) -> Vector3:
    """Force of the contact in `scene` at `CONTACT_POINT`, N; zero most of the time."""
    phase = (seconds - CONTACT_START) % CONTACT_PERIOD
    touches = seconds >= CONTACT_START and phase < CONTACT_LENGTH
    push = math.sin(math.pi * phase / CONTACT_LENGTH) ** 2 if touches else 0.0
    x, y, z = CONTACT_FORCE
    return x * push, y * push, z * push


def carry(angles: Angles, acceleration: Vector3 = (0.0, 0.0, 0.0)) -> Felt:
    """What a sensor with the tool feels whose wrench origin is accelerated, m/s², and which turns so.

    A rigid body on a SensONE. Specific force f = R^T (a - g), so +1 g upward when stationary, and elsewhere
    f + spin x r + rate x (rate x r); at the center of gravity it makes the force F = -m f, and the torque
    r x F - (J spin + rate x J rate).
    """
    attitude, (yaw1, pitch1, roll1), (yaw2, pitch2, roll2) = angles
    cy, sy, cp, sp, cr, sr = _cosines_and_sines(attitude)
    rate = roll1 - yaw1 * sp, pitch1 * cr + yaw1 * cp * sr, -pitch1 * sr + yaw1 * cp * cr
    spin = (
        roll2 - yaw2 * sp - yaw1 * pitch1 * cp,
        pitch2 * cr - pitch1 * roll1 * sr + yaw2 * cp * sr + yaw1 * (roll1 * cp * cr - pitch1 * sp * sr),
        -pitch2 * sr - pitch1 * roll1 * cr + yaw2 * cp * cr - yaw1 * (roll1 * cp * sr + pitch1 * sp * cr),
    )
    x, y, z = acceleration
    z += STANDARD_GRAVITY
    felt = (
        cy * cp * x + sy * cp * y - sp * z,
        (cy * sp * sr - sy * cr) * x + (sy * sp * sr + cy * cr) * y + cp * sr * z,
        (cy * sp * cr + sy * sr) * x + (sy * sp * cr - cy * sr) * y + cp * cr * z,
    )

    def at(place: Vector3) -> Vector3:
        turned, turning = cross(spin, place), cross(rate, cross(rate, place))
        return (
            felt[0] + turned[0] + turning[0],
            felt[1] + turned[1] + turning[1],
            felt[2] + turned[2] + turning[2],
        )

    fx, fy, fz = at(TOOL_CENTRE)
    force = -TOOL_MASS * fx, -TOOL_MASS * fy, -TOOL_MASS * fz
    parts = zip(cross(TOOL_CENTRE, force), _momentum(spin), cross(rate, _momentum(rate)), strict=True)
    torque = tuple(held - spun - turned for held, spun, turned in parts)
    return Felt((*force, *torque), at(_IMU), rate, attitude=attitude)


def _momentum(rate: Vector3) -> Vector3:
    """The tool's tensor times this."""
    (x, y, z), (xx, yy, zz, xy, xz, yz) = rate, TOOL_INERTIA
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


def scene(seconds: float) -> Felt:
    """A tool on a swaying wrist, which is accelerated, too, and touches something now and then."""
    ax, ay, az = (a * math.sin(w * seconds) for a, w in _SHAKE)
    felt, contact = carry(sway(seconds), (ax, ay, az)), contact_force(seconds)
    if not any(contact):
        return felt
    touched = (*contact, *cross(CONTACT_POINT, contact))
    return felt._replace(wrench=tuple(map(operator.add, felt.wrench, touched)))


POSE_LENGTH, MOVE_LENGTH = 3.0, 2.0  # duration of a pose, and of the move to the next, s
# Pitch and roll, in right angles: the axes +z, +y, -z, -y, +x and -x of the sensor point up.
_POSES: Final = ((0, 0), (0, 1), (0, 2), (0, 3), (-1, 4), (1, 4), (0, 4))  # the last is the first again


def poses(seconds: float) -> Felt:
    """The tool held in six poses, one after another."""
    number, passed = divmod(seconds, POSE_LENGTH + MOVE_LENGTH)
    here, following = _POSES[int(number) % 6], _POSES[int(number) % 6 + 1]
    s = max(0.0, passed - POSE_LENGTH) / MOVE_LENGTH
    # Smooth from standstill to standstill.
    share, rate = s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * s * s * (1.0 - s) ** 2 / MOVE_LENGTH
    spin = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / MOVE_LENGTH**2
    (pitch, roll), (pitch_begin, roll_begin) = (
        (math.pi / 2 * (b - a) for a, b in zip(here, following, strict=True)),
        (math.pi / 2 * a for a in here),
    )
    return carry(
        (
            (0.0, pitch_begin + share * pitch, roll_begin + share * roll),
            (0.0, rate * pitch, rate * roll),
            (0.0, spin * pitch, spin * roll),
        )
    )


SCENES: Final = {"scene": scene, "poses": poses}
SIGNALS: Final = (*SCENES, *FORMULAS)
