"""Identity, state and error counters of the slaves, read without changing them.

Without a scan, which would take them to INIT and clear their counters as every start of a master does.
Registers are addressed by position. Source: ETG.1000.4.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Final

from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave.al import AlStatus
from ethercat_server.ethercat.slave.registers import (
    AL_STATUS,
    AL_STATUS_SIZE,
    DL_STATUS,
    ERROR_COUNTERS_SIZE,
    RX_ERRORS,
    WATCHDOG_COUNTER,
)
from ethercat_server.sensor.objects.dictionary import is_sensor
from ethercat_server.sensor.scan import look_at, with_sii

MOST_PORTS: Final = 4
_ATTEMPTS: Final = 10
_FIND_ATTEMPTS: Final = 5
_FIND_TIMEOUT_S: Final = 0.05
_PROBE_SIZE: Final = 2


@dataclass(frozen=True)
class ErrorCounters:
    """Error counters of an ESC; each saturates at 255."""

    invalid: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: corrupted frames received."""
    physical: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: errors that the physical layer reported."""
    forwarded: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: frames that another slave had found corrupted."""
    processing_unit: int = 0
    pdi: int = 0
    lost_links: tuple[int, ...] = (0,) * MOST_PORTS

    @classmethod
    def parse(cls, data: bytes) -> ErrorCounters:
        """From the registers 0x0300 to 0x0313."""
        return cls(
            tuple(data[0:8:2]), tuple(data[1:8:2]), tuple(data[8:12]), data[12], data[13], tuple(data[16:20])
        )

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()
        }


@dataclass(frozen=True)
class Slave:
    """One slave."""

    position: int
    al: AlStatus
    counters: ErrorCounters = ErrorCounters()
    links: tuple[bool, ...] = (True, False, False, False)
    """Which ports have a link."""
    watchdogs: int = 0
    """Number of expired process data watchdogs."""
    vendor: int = 0
    product: int = 0
    serial: int = 0
    name: str = ""
    sii_problem: str = ""
    """Why its SII, and so its identity, could not be read."""
    at_work: bool = False
    """It is no Bota sensor and in SAFEOP, OP or BOOT."""
    left_alone: bool = False
    """Its SII was not read, for another master has the bus."""

    @property
    def is_sensor(self) -> bool:
        """Whether it is a Bota Gen-0 sensor."""
        return is_sensor(self.vendor, self.product)

    def as_json(self) -> dict[str, Any]:
        """Its JSON form."""
        return {"sensor": self.position, "name": self.name, "serial": self.serial, "vendor": self.vendor,
                "product": self.product, "al_state": self.al.state.name, "al_error": self.al.error,
                "al_status_code": self.al.code}  # fmt: skip


def count(bus: Bus) -> int:
    """Number of slaves that answer."""
    return max(0, *(bus.count_slaves(_PROBE_SIZE, _FIND_TIMEOUT_S) for _ in range(_FIND_ATTEMPTS)))


def in_use(bus: Bus, count: int) -> bool:
    """Whether a slave that is no Bota sensor is in SAFEOP, OP or BOOT; BusError if one does not answer."""
    return any(look_at(bus, position).at_work for position in range(count))


def look(bus: Bus, position: int, *, in_use: bool) -> Slave:
    """The slave at `position`; BusError if it does not answer. `in_use`: another master has the bus."""
    al = AlStatus.parse(bus.read_surely_at(position, AL_STATUS, AL_STATUS_SIZE))
    (links,) = struct.unpack("<H", bus.read_surely_at(position, DL_STATUS, 2))
    counters = read_counters(bus, position)
    watchdogs = bus.read_surely_at(position, WATCHDOG_COUNTER, 1)[0]
    found: dict[str, Any] = {
        "position": position, "al": al, "counters": counters, "watchdogs": watchdogs,
        "links": tuple(bool(links >> (4 + port) & 1) for port in range(MOST_PORTS)),
    }  # fmt: skip
    looked = look_at(bus, position)
    if in_use:
        return Slave(**found, at_work=looked.at_work, left_alone=True)
    looked = with_sii(bus, looked)
    if looked.sii is None:
        return Slave(**found, sii_problem=looked.problem)
    names = ("vendor", "product", "serial", "name")
    return Slave(**found, **{name: looked.sii[name] for name in names})


def read_counters(bus: Bus, position: int) -> ErrorCounters:
    """The error counters of the slave at `position`; BusError if it does not answer."""
    return ErrorCounters.parse(bus.read_surely_at(position, RX_ERRORS, ERROR_COUNTERS_SIZE))
