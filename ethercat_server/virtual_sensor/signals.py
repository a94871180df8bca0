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
CONTACT_POINT: Vector3 = (0.0, 0.0, 0.12)  # on the tool, m
CONTACT_START, CONTACT_LENGTH, CONTACT_PERIOD = 5.0, 0.6, 7.0  # s: of the first; from one to the next
CONTACT_FORCE: Vector3 = (3.0, -2.0, -12.0)  # at its peak, N, in the sensor's frame


def sway(seconds: float) -> tuple[Vector3, Vector3]:
    """Never stationary: yaw, pitch and roll swing."""
    yaw, pitch, roll = (a * math.sin(w * seconds) for a, w in _SWINGS)
    yaw_rate, pitch_rate, roll_rate = (a * w * math.cos(w * seconds) for a, w in _SWINGS)
    return (yaw, pitch, roll), (yaw_rate, pitch_rate, roll_rate)


def contact_force(seconds: float) -> Vector3:
    """Force of the contact in `scene` at `CONTACT_POINT`, N; zero most of the time."""
    phase = (seconds - CONTACT_START) % CONTACT_PERIOD
    touches = seconds >= CONTACT_START and phase < CONTACT_LENGTH
    push = math.sin(math.pi * phase / CONTACT_LENGTH) ** 2 if touches else 0.0
    x, y, z = CONTACT_FORCE
    return x * push, y * push, z * push


def carry(attitude: Vector3, rates: Vector3, acceleration: Vector3 = (0.0, 0.0, 0.0)) -> Felt:
    """What a sensor with the tool feels: `rates` are the attitude's derivatives, rad/s; acceleration, m/s².

    Specific force f = R^T (a - g), so +1 g upward when stationary; tool force F = m R^T (g - a) = -m f;
    torque r x F. The tool's own rotational inertia and the lever arm to the IMU are neglected.
    """
    cy, sy, cp, sp, cr, sr = _cosines_and_sines(attitude)
    yaw_rate, pitch_rate, roll_rate = rates
    turning = (
        roll_rate - yaw_rate * sp,
        pitch_rate * cr + yaw_rate * cp * sr,
        -pitch_rate * sr + yaw_rate * cp * cr,
    )
    x, y, z = acceleration
    z += STANDARD_GRAVITY
    fx = cy * cp * x + sy * cp * y - sp * z
    fy = (cy * sp * sr - sy * cr) * x + (sy * sp * sr + cy * cr) * y + cp * sr * z
    fz = (cy * sp * cr + sy * sr) * x + (sy * sp * cr - cy * sr) * y + cp * cr * z
    weight = (-TOOL_MASS * fx, -TOOL_MASS * fy, -TOOL_MASS * fz)
    return Felt((*weight, *cross(TOOL_CENTRE, weight)), (fx, fy, fz), turning, attitude=attitude)


def scene(seconds: float) -> Felt:
    """A tool on a swaying wrist, which is accelerated, too, and touches something now and then."""
    ax, ay, az = (a * math.sin(w * seconds) for a, w in _SHAKE)
    felt, contact = carry(*sway(seconds), (ax, ay, az)), contact_force(seconds)
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
    (pitch, pitch_rate), (roll, roll_rate) = (
        (math.pi / 2 * (a + share * (b - a)), math.pi / 2 * rate * (b - a))
        for a, b in zip(here, following, strict=True)
    )
    return carry((0.0, pitch, roll), (0.0, pitch_rate, roll_rate))


SCENES: Final = {"scene": scene, "poses": poses}
SIGNALS: Final = (*SCENES, *FORMULAS)
