"""Looks at a bus before it is scanned: which slaves there are, whose they are, and whether they are at work.

Looking disturbs nobody: frames of other masters are counted, registers and SIIs (EEPROMs) are read. Not the
SII of a slave in SAFEOP, OP or BOOT, for reading takes writes to its controller; what is Bota's is then told
from its sync managers.
"""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave import sii_content
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from ethercat_server.ethercat.slave.coe import finish
from ethercat_server.ethercat.slave.sii import ByPosition, read_sii
from ethercat_server.sensor.objects.dictionary import is_sensor
from protocol.pdo import LAYOUTS

_LISTEN_S: Final = 0.1
_MASTER_FRAMES: Final = 3
"""Frames in this time that are a master's cycle; fewer may be the last ones of a server that was killed."""
_TIMEOUT_S: Final = 0.02
_ATTEMPTS: Final = 5
_PROBE_BYTES: Final = 1
_SII_PAUSE_S: Final = 0.0002
"""Until an EEPROM is asked again whether it has read a word, which takes it one to three milliseconds."""
_MAILBOXES_AND_OUTPUTS: Final = ((0x1000, 128), (0x1080, 128), (0x1100, 1))
"""Start and length of a Bota sensor's sync managers 0 to 2."""
_INPUTS: Final = 0x1180
_SYNC_MANAGER: Final = struct.Struct("<HH4x")
_NAMELESS: Final = "nameless"
_KNOWN: Final = ("vendor", "product", "revision", "name")
"""What `describe` says of a slave from its SII."""


class NoSlaveError(BusError):
    """No slave answers."""


class Slave(NamedTuple):
    """One slave on the wire, of any vendor."""

    position: int
    status: AlStatus
    sii: sii_content.Sii | None
    """None if it was not read."""
    problem: str = ""
    """Why its SII cannot be read."""
    at_work: bool = False
    """It is no Bota sensor and in SAFEOP, OP or BOOT."""

    @property
    def name(self) -> str:
        """For people."""
        return (self.sii and self.sii["name"]) or _NAMELESS

    @property
    def is_sensor(self) -> bool:
        """Whether it is a Bota Gen-0 sensor."""
        return self.sii is not None and is_sensor(self.sii["vendor"], self.sii["product"])

    @property
    def has_coe(self) -> bool:
        """Whether it has a mailbox with CoE, and so objects."""
        return self.sii is not None and "CoE" in self.sii["protocols"]

    def as_json(self) -> dict[str, Any]:
        """Its part of `others` in the `describe` reply."""
        known = dict.fromkeys(_KNOWN) if self.sii is None else {key: self.sii[key] for key in _KNOWN}
        return {"position": self.position, **known, "state": self.status.state.name}

    def __str__(self) -> str:
        who = "its SII cannot be read"
        if self.sii is not None:
            who = f"vendor 0x{self.sii['vendor']:08X}, product 0x{self.sii['product']:08X}"
        return f"{self.name!r} at position {self.position} ({who})"


def check_no_master(bus: Bus) -> None:
    """BusError if another master is sending."""
    if (count := bus.listen(_LISTEN_S)) >= _MASTER_FRAMES:
        raise BusError(
            f"another EtherCAT master is sending on {bus.ifname} ({count} frames in {_LISTEN_S:g} s): stop "
            "it, or name the interface that the sensor is connected to; --force takes its slaves over"
        )


def look(bus: Bus, check_interrupt: CheckInterrupt) -> list[Slave]:
    """All slaves, in their order on the wire, without their SIIs; BusError if there are none."""
    count = max(bus.count_slaves(_PROBE_BYTES, _TIMEOUT_S) for _ in range(_ATTEMPTS))
    if count <= 0:
        raise NoSlaveError(
            f"no EtherCAT slave answers on {bus.ifname}: check the cable, that the sensor has power and "
            "that this is the interface it is connected to"
        )
    found = []
    for position in range(count):
        check_interrupt()
        found.append(look_at(bus, position))
    return found


def look_at(bus: Bus, position: int) -> Slave:
    """The slave at `position`, without its SII; BusError if it does not answer."""
    status = AlStatus.parse(bus.read_surely_at(position, reg.AL_STATUS, reg.AL_STATUS_SIZE))
    busy = status.is_above_preop or status.state is AlState.BOOT  # its firmware may be being written
    at_work = busy and not _has_sensors_managers(bus, position)
    return Slave(position, status, None, at_work=at_work)


def with_sii(bus: Bus, slave: Slave, check_interrupt: CheckInterrupt = lambda: None) -> Slave:
    """The same slave with its SII; access to the SII returns to its owner afterwards."""
    try:
        content = sii_content.decode(read_image(bus, slave.position, check_interrupt))
    except BusError as error:
        return slave._replace(problem=str(error))
    if not content["vendor"] and not content["product"]:
        return slave._replace(problem="its SII is empty")
    return slave._replace(sii=content)


def read_image(bus: Bus, position: int, check_interrupt: CheckInterrupt = lambda: None) -> bytes:
    """The SII of the slave at `position`; BusError if it cannot be read."""
    owner = bus.read_surely_at(position, reg.SII_OWNER, 1)
    registers = ByPosition(bus)

    def read(word: int, words: int) -> bytes:
        steps = read_sii(registers, position, word, words, owner)
        return finish(steps, pause_s=_SII_PAUSE_S, clock=bus.clock, check_interrupt=check_interrupt)

    return sii_content.read_image(read)


def _has_sensors_managers(bus: Bus, position: int) -> bool:
    data = bus.read_surely_at(position, reg.SYNC_MANAGER, 4 * reg.SYNC_MANAGER_SIZE)
    *others, inputs = _SYNC_MANAGER.iter_unpack(data)
    return tuple(others) == _MAILBOXES_AND_OUTPUTS and inputs in [(_INPUTS, size) for size in LAYOUTS]
