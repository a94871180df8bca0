"""The slaves on the bus, looked at without changing them: who they are, their state, what they have counted.

No scan: that would take them to INIT and set their counters to zero, as the start of every master does.
Registers are read by place on the bus. Source: ETG.1000.4.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, Final

from ethercat_server.al import AL_STATUS, AL_STATUS_SIZE, AlStatus
from ethercat_server.bus import Bus
from ethercat_server.errors import BusError
from ethercat_server.sdo import finish
from ethercat_server.sii import SII_OWNER, read_sii
from ethercat_server.tool import sii

MOST_PORTS: Final = 4
_DL_STATUS: Final = 0x0110
_COUNTERS: Final = 0x0300
_COUNTERS_SIZE: Final = 0x14
_WATCHDOG_COUNTER: Final = 0x0442
_ATTEMPTS: Final = 10
_FIND_ATTEMPTS: Final = 5
_FIND_TIMEOUT_S: Final = 0.05
_PROBE_SIZE: Final = 2


@dataclass(frozen=True)
class ErrorCounters:
    """What an ESC has counted since it was switched on or cleared; each stays at 255."""

    invalid: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: frames that arrived damaged."""
    physical: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: errors that the physical layer reported."""
    forwarded: tuple[int, ...] = (0,) * MOST_PORTS
    """By port: frames that a slave before this one found damaged."""
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
        """By name."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()
        }


@dataclass(frozen=True)
class Slave:
    """One slave as it was found."""

    place: int
    al: AlStatus
    counters: ErrorCounters = ErrorCounters()
    links: tuple[bool, ...] = (True, False, False, False)
    """Which ports have a link."""
    watchdogs: int = 0
    """How often no process data came for too long."""
    vendor: int = 0
    product: int = 0
    serial: int = 0
    name: str = ""
    sii_problem: str = ""
    """Why its SII could not be read; who it is is not known then."""

    def as_json(self) -> dict[str, Any]:
        """Who it is."""
        return {"sensor": self.place, "name": self.name, "serial": self.serial, "vendor": self.vendor,
                "product": self.product, "al_state": self.al.state.name, "al_error": self.al.error,
                "al_status_code": self.al.code}  # fmt: skip


def count(bus: Bus) -> int:
    """How many slaves answer; 0 if none does."""
    return max(0, *(bus.count_slaves(_PROBE_SIZE, _FIND_TIMEOUT_S) for _ in range(_FIND_ATTEMPTS)))


def look(bus: Bus, place: int) -> Slave:
    """The slave at `place`; BusError if it does not answer."""
    al = AlStatus.parse(_read(bus, place, AL_STATUS, AL_STATUS_SIZE))
    (links,) = struct.unpack("<H", _read(bus, place, _DL_STATUS, 2))
    counters = read_counters(bus, place)
    watchdogs = _read(bus, place, _WATCHDOG_COUNTER, 1)[0]
    found: dict[str, Any] = {
        "place": place, "al": al, "counters": counters, "watchdogs": watchdogs,
        "links": tuple(bool(links >> (4 + port) & 1) for port in range(MOST_PORTS)),
    }  # fmt: skip
    try:
        image = sii.decode(_read_sii(bus, place))
    except BusError as error:
        return Slave(**found, sii_problem=str(error))
    names = ("vendor", "product", "serial", "name")
    return Slave(**found, **{name: image[name] for name in names})


def read_counters(bus: Bus, place: int) -> ErrorCounters:
    """The error counters of the slave at `place`, which go on counting; BusError if it does not answer."""
    return ErrorCounters.parse(_read(bus, place, _COUNTERS, _COUNTERS_SIZE))


def _read(bus: Bus, place: int, address: int, size: int) -> bytes:
    for _ in range(_ATTEMPTS):
        data = bus.read_at(place, address, size)
        if data is not None:
            return data
    raise BusError(f"slave {place} does not answer reading register 0x{address:04X}: check cable and power")


def _read_sii(bus: Bus, place: int) -> bytes:
    """Who had the right to use the SII has it again."""
    owner = _read(bus, place, SII_OWNER, 1)
    registers = _ByPlace(bus)

    def read(word: int, words: int) -> bytes:
        return finish(read_sii(registers, place, word, words, owner), pause_s=0)

    return sii.read_image(read)


class _ByPlace:
    """Registers of slaves that were not scanned."""

    def __init__(self, bus: Bus) -> None:
        self.read_register, self.write_register = bus.read_at, bus.write_at
