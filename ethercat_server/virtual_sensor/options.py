"""What a virtual sensor, or a chain of them, is to be."""

from __future__ import annotations

from dataclasses import dataclass, field

from ethercat_server.objects import MODELS


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """One sensor."""

    model: str = MODELS[0]
    serial: int = 1
    pdo_size: int = 61
    sinc_length: int | None = None
    """None: what the sensor's flash holds, 64 as it leaves the factory."""
    ppm: float = 0.0
    """Error of its clock: positive is fast."""
    signal: str = "scene"
    noise: bool = True
    seed: int = 0


@dataclass(frozen=True, slots=True)
class BusOptions:
    """A chain of sensors, first to last."""

    sensors: tuple[SensorOptions, ...] = field(default_factory=lambda: (SensorOptions(),))
