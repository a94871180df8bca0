"""Options of a simulated sensor, of a foreign slave, and of a chain."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from ethercat_server.sensor.objects.dictionary import MODELS
from ethercat_server.virtual_sensor.slave.al import AlState

WRITE_US: Final = 12.0
"""About what 61 bytes take over SPI at 40 MHz."""
EEPROM_MS: Final = 2.0
"""About what a real EEPROM needs for the eight bytes of a read command."""


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
    dc: str = ""
    """What its distributed clock is like, in the words of `dc.kinds`: `32-bit+ppm=20+late=50`."""
    write_us: float = WRITE_US
    """Time that its firmware takes to write a sample to the controller, before the sample's instant."""
    signal: str = "scene"
    noise: bool = True
    seed: int = 0
    state: AlState = AlState.INIT
    """In which another master has left it."""
    eeprom_ms: float = EEPROM_MS
    """Time that reading from its EEPROM takes."""


@dataclass(frozen=True, slots=True)
class ForeignOptions:
    """One slave of another vendor."""

    kind: str
    """One of `foreign.kinds.KINDS`."""
    state: AlState = AlState.INIT
    """In which another master has left it; a drive in OP turns."""
    eeprom_ms: float = EEPROM_MS


SlaveOptions = SensorOptions | ForeignOptions


@dataclass(frozen=True, slots=True)
class BusOptions:
    """A chain of slaves, first to last."""

    slaves: tuple[SlaveOptions, ...] = field(default_factory=lambda: (SensorOptions(),))

    @property
    def sensors(self) -> tuple[SensorOptions, ...]:
        """The sensors among them."""
        return tuple(slave for slave in self.slaves if isinstance(slave, SensorOptions))
