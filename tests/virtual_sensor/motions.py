"""A world, a tool that turns; and a sensor that measures one."""

from __future__ import annotations

import math
from typing import Any, Final

from bota_ethercat.pdo import Vector3
from bota_ethercat.settings import start_up_defaults
from bota_ethercat.world import Felt
from ethercat_server.virtual_sensor.signals import carry, scene
from ethercat_server.virtual_sensor.world import Measured, World

TURN_LENGTH: Final = 60.0  # duration of a full turn, s
_TURN_PITCH: Final = 0.6


def turn(seconds: float) -> tuple[Vector3, Vector3]:
    """A slow whole turn, over and over: rolls round once while it pitches up and down."""
    speed = math.tau / TURN_LENGTH
    rolled = speed * seconds
    pitch, rate = _TURN_PITCH * math.sin(rolled), _TURN_PITCH * speed * math.cos(rolled)
    return (0.0, pitch, rolled), (0.0, rate, speed)


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
