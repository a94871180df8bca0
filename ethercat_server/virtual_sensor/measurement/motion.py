"""Motion of the wrist in the signals `scene`, `poses` and `turn`; functions of an attitude.

Frames: the sensor's, with z out of the tool side; the world's, with z up. An attitude is yaw, pitch and roll
(rad) about z, y', x''; it turns sensor vectors into world vectors.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Final

Vector = tuple[float, float, float]


def quaternion(attitude: Vector) -> tuple[float, float, float, float]:
    """The attitude as x, y, z, w."""
    yaw, pitch, roll = (angle / 2 for angle in attitude)
    cy, sy, cp, sp, cr, sr = (
        math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
    )  # fmt: skip
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def angular_rate(attitude: Vector, rates: Vector) -> Vector:
    """Angular velocity in the sensor's frame, rad/s, from the derivatives of yaw, pitch and roll."""
    _, pitch, roll = attitude
    yaw_rate, pitch_rate, roll_rate = rates
    return (
        roll_rate - yaw_rate * math.sin(pitch),
        pitch_rate * math.cos(roll) + yaw_rate * math.cos(pitch) * math.sin(roll),
        -pitch_rate * math.sin(roll) + yaw_rate * math.cos(pitch) * math.cos(roll),
    )


def to_sensor(attitude: Vector, vector: Vector) -> Vector:
    """A world vector in the sensor's frame."""
    yaw, pitch, roll = attitude
    cy, sy, cp, sp, cr, sr = (
        math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
    )  # fmt: skip
    x, y, z = vector
    return (
        cy * cp * x + sy * cp * y - sp * z,
        (cy * sp * sr - sy * cr) * x + (sy * sp * sr + cy * cr) * y + cp * sr * z,
        (cy * sp * cr + sy * sr) * x + (sy * sp * cr - cy * sr) * y + cp * cr * z,
    )


class Motion(ABC):
    """A movement of the wrist; `seconds` count from power-on."""

    touches = False
    """Whether there are contacts."""

    @abstractmethod
    def attitude(self, seconds: float) -> tuple[Vector, Vector]:
        """Yaw, pitch and roll (rad), and their derivatives (rad/s)."""

    def acceleration(self, seconds: float) -> Vector:  # noqa: ARG002
        """Of the wrist, in the world's frame, m/s²; none where it only turns."""
        return 0.0, 0.0, 0.0


class Swaying(Motion):
    """Never stationary: yaw, pitch and roll swing, the wrist shakes, and the tool touches something."""

    touches = True
    # Amplitude (rad) and angular frequency (rad/s) of yaw, pitch and roll.
    _SWINGS = ((0.5, 0.31), (0.45, 0.23), (0.6, 0.37))
    # Amplitude (m/s²) and angular frequency of the wrist's acceleration along each world axis.
    _SHAKE = ((0.15, 1.7), (0.10, 2.3), (0.20, 1.1))

    def attitude(self, seconds: float) -> tuple[Vector, Vector]:
        """See `Motion`."""
        yaw, pitch, roll = (a * math.sin(w * seconds) for a, w in self._SWINGS)
        yaw_rate, pitch_rate, roll_rate = (a * w * math.cos(w * seconds) for a, w in self._SWINGS)
        return (yaw, pitch, roll), (yaw_rate, pitch_rate, roll_rate)

    def acceleration(self, seconds: float) -> Vector:
        """See `Motion`."""
        ax, ay, az = (a * math.sin(w * seconds) for a, w in self._SHAKE)
        return ax, ay, az


POSE_LENGTH: Final = 3.0
"""Duration of a pose, s."""
MOVE_LENGTH: Final = 2.0
"""Duration of the move between poses, s."""
_QUARTER: Final = math.pi / 2
POSES: Final[tuple[tuple[str, Vector], ...]] = (
    ("+z", (0.0, 0.0, 0.0)),
    ("+y", (0.0, 0.0, _QUARTER)),
    ("-z", (0.0, 0.0, 2 * _QUARTER)),
    ("-y", (0.0, 0.0, 3 * _QUARTER)),
    ("+x", (0.0, -_QUARTER, 4 * _QUARTER)),
    ("-x", (0.0, _QUARTER, 4 * _QUARTER)),
)
"""The axis of the sensor that points up, and yaw, pitch and roll. After the last comes the first again."""


class Posing(Motion):
    """The six poses in which one axis of the sensor points up or down, one after another."""

    def attitude(self, seconds: float) -> tuple[Vector, Vector]:
        """See `Motion`."""
        number, passed = divmod(seconds, POSE_LENGTH + MOVE_LENGTH)
        here = POSES[int(number) % len(POSES)][1]
        if passed < POSE_LENGTH:
            return here, (0.0, 0.0, 0.0)
        following = POSES[(int(number) + 1) % len(POSES)][1]
        s = (passed - POSE_LENGTH) / MOVE_LENGTH
        # Smooth from standstill to standstill.
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = 30.0 * s * s * (1.0 - s) ** 2 / MOVE_LENGTH
        # The first pose again is a whole roll further on.
        yaw, pitch, roll = (b - a for a, b in zip(here, following, strict=True))
        if following is POSES[0][1]:
            roll += math.tau
        return (
            (here[0] + share * yaw, here[1] + share * pitch, here[2] + share * roll),
            (rate * yaw, rate * pitch, rate * roll),
        )


TURN_LENGTH: Final = 60.0
"""Duration of a full turn, s."""


class Turning(Motion):
    """A slow whole turn, over and over: rolls round once while it pitches up and down."""

    _PITCH = 0.6

    def attitude(self, seconds: float) -> tuple[Vector, Vector]:
        """See `Motion`."""
        speed = math.tau / TURN_LENGTH
        turned = speed * seconds
        return (
            (0.0, self._PITCH * math.sin(turned), turned),
            (0.0, self._PITCH * speed * math.cos(turned), speed),
        )


MOTIONS: Final[dict[str, type[Motion]]] = {
    "scene": Swaying,
    "poses": Posing,
    "turn": Turning,
}
"""The physical signals, by name."""
