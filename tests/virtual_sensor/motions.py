"""Worlds: a tool that takes six poses, and one that turns; and a sensor that measures them."""

from __future__ import annotations

import math
from typing import Any, Final

from bota_ethercat.settings import start_up_defaults
from bota_ethercat.world import Felt
from ethercat_server.virtual_sensor.signals import Vector, carry, scene
from ethercat_server.virtual_sensor.world import Measured, World

POSE_LENGTH: Final = 3.0  # duration of a pose, s
MOVE_LENGTH: Final = 2.0  # of the move between poses, s
_QUARTER: Final = math.pi / 2
# The axis of the sensor that points up, and yaw, pitch and roll. After the last comes the first again.
POSES: Final[tuple[tuple[str, Vector], ...]] = (
    ("+z", (0.0, 0.0, 0.0)),
    ("+y", (0.0, 0.0, _QUARTER)),
    ("-z", (0.0, 0.0, 2 * _QUARTER)),
    ("-y", (0.0, 0.0, 3 * _QUARTER)),
    ("+x", (0.0, -_QUARTER, 4 * _QUARTER)),
    ("-x", (0.0, _QUARTER, 4 * _QUARTER)),
)
TURN_LENGTH: Final = 60.0  # duration of a full turn, s
_TURN_PITCH: Final = 0.6


def pose(seconds: float) -> tuple[Vector, Vector]:
    """The six poses in which one axis of the sensor points up or down, one after another."""
    number, passed = divmod(seconds, POSE_LENGTH + MOVE_LENGTH)
    here = POSES[int(number) % len(POSES)][1]
    if passed < POSE_LENGTH:
        return here, (0.0, 0.0, 0.0)
    following = POSES[(int(number) + 1) % len(POSES)][1]
    s = (passed - POSE_LENGTH) / MOVE_LENGTH
    # Smooth from standstill to standstill.
    share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    rate = 30.0 * s * s * (1.0 - s) ** 2 / MOVE_LENGTH
    yaw, pitch, roll = (b - a for a, b in zip(here, following, strict=True))
    if following is POSES[0][1]:  # the first pose again is a whole roll further on
        roll += math.tau
    return (
        (here[0] + share * yaw, here[1] + share * pitch, here[2] + share * roll),
        (rate * yaw, rate * pitch, rate * roll),
    )


def turn(seconds: float) -> tuple[Vector, Vector]:
    """A slow whole turn, over and over: rolls round once while it pitches up and down."""
    speed = math.tau / TURN_LENGTH
    rolled = speed * seconds
    pitch, rate = _TURN_PITCH * math.sin(rolled), _TURN_PITCH * speed * math.cos(rolled)
    return (0.0, pitch, rolled), (0.0, rate, speed)


def poses(seconds: float) -> Felt:
    """What a sensor feels that takes the poses."""
    return carry(*pose(seconds))


def turning(seconds: float) -> Felt:
    """What a sensor feels that turns."""
    return carry(*turn(seconds))


def measured(
    world: World = scene, sinc: int = 64, *, seed: int = 0, noise: bool = False, **changed: Any
) -> Measured:
    """A sensor in this world, with these settings."""
    sensor = Measured(world, seed, noise)
    sensor.set_filters(sinc, start_up_defaults() | changed)
    return sensor
