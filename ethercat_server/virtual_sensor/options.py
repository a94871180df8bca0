"""Options of a simulated sensor and of a chain."""

from __future__ import annotations

from dataclasses import dataclass, field

from ethercat_server.sensor.objects.dictionary import MODELS


@dataclass(frozen=True, slots=True)
class SensorOptions:
    """One sensor."""

    model: str = MODELS[0]
    serial: int = 1
    pdo_size: int = 61
    sinc_length: int | None = None
    """None: the value in flash, by default 64."""
    chop_divides: int = 1
    """By what CHOP divides its sampling rate."""
    ppm: float = 0.0
    """Error of its clock: positive is fast."""
    signal: str = "scene"
    noise: bool = True
    seed: int = 0


@dataclass(frozen=True, slots=True)
class BusOptions:
    """A chain of sensors, first to last."""

    sensors: tuple[SensorOptions, ...] = field(default_factory=lambda: (SensorOptions(),))
