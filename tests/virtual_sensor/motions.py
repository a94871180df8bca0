"""A world, a tool that turns; and a sensor that measures one."""

from __future__ import annotations

import math
from typing import Any, Final

from bota_ethercat.settings import start_up_defaults
from bota_ethercat.world import Felt
from ethercat_server.virtual_sensor.signals import World, carry, scene
from ethercat_server.virtual_sensor.world import Measured

TURN_LENGTH: Final = 60.0  # duration of a full turn, s
_PITCH: Final = 0.6  # rad


def turning(seconds: float) -> Felt:
    """Rolls round slowly, over and over, while it pitches up and down."""
    speed = math.tau / TURN_LENGTH
    rolled = speed * seconds
    pitch, rate = _PITCH * math.sin(rolled), _PITCH * speed * math.cos(rolled)
    return carry(((0.0, pitch, rolled), (0.0, rate, speed), (0.0, -speed * speed * pitch, 0.0)))


def measured(
    world: World = scene, sinc: int = 64, *, seed: int = 0, noise: bool = False, **changed: Any
) -> Measured:
    """A sensor in this world, with these settings."""
    sensor = Measured(world, seed, noise)
    sensor.set_filters(sinc, start_up_defaults() | changed)
    return sensor
