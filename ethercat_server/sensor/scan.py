"""Which slaves are on a bus, which of them are sensors or operational, and whether a master is active.

Nothing is disturbed: frames of other masters are counted, registers and SIIs (EEPROMs) are read. The SII of a
slave in SAFEOP, OP or BOOT is not read, because that takes writes to its controller, unless it may be stopped
and must be what its name says; a Bota sensor is then recognized by its sync managers.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from bota_ethercat.pdo import LAYOUTS
from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.datagrams import ByPosition, Steps
from ethercat_server.ethercat.nic import CHECK_CABLE
from ethercat_server.ethercat.other_master import refuse_other_master
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave import sii
from ethercat_server.ethercat.slave.al import STATE_S, AlState, AlStatus
from ethercat_server.ethercat.slave.sii import read_sii
from ethercat_server.sensor.objects.dictionary import is_sensor

_PAUSE_S: Final = 0.002
# Start and length of a Bota sensor's sync managers 0 to 2, and start of the last one.
_MAILBOXES_AND_OUTPUTS: Final = ((0x1000, 128), (0x1080, 128), (0x1100, 1))
_INPUTS: Final = 0x1180
_NAMELESS: Final = "nameless"
_KNOWN: Final = ("vendor", "product", "revision", "name")  # what `describe` says of a slave from its SII
_MOST_LISTED: Final = 64
_ABSENT_AFTER: Final = 3  # unanswered reads in a row; a single lost datagram says nothing
_ABSENT: Final = "ABSENT"
Kind = tuple[int, int]  # vendor and product

log = logging.getLogger(__name__)


class NoSlaveError(BusError):
    """No slave answers."""


class Slave(NamedTuple):
    """One slave on the wire, of any vendor."""

    position: int
    status: AlStatus
    sii: sii.Sii | None  # None if it was not read
    problem: str = ""  # why its SII cannot be read
    at_work: bool = False  # in SAFEOP, OP or BOOT, and not a Bota sensor

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


def scan_if_free(
    bus: Bus, check_interrupt: CheckInterrupt, *, force: bool = False, ours: Mapping[int, Kind | None] = {}
) -> list[Slave]:
    """All slaves, in their order on the wire, with their SIIs; NoSlaveError if there are none.

    BusError if using the bus would stop another machine: if another master is sending, or a slave that is
    not Bota's is in SAFEOP, OP or BOOT. With `force`, such slaves are taken to PREOP instead, and
    those without outputs at the positions `ours`, where a server that was killed has left them: what is there
    by its SII must be what is named.
    """
    if not force:
        refuse_other_master(bus)
    check_interrupt()
    slaves = []
    for position in range(bus.count_slaves()):
        check_interrupt()
        slaves.append(look_at(bus, position))
    if not slaves:
        why = bus.backend.why_silent()
        if why == CHECK_CABLE:
            why = (
                "check the cable, that the sensor has power and that this is the interface it is connected to"
            )
        raise NoSlaveError(f"no EtherCAT slave answers on {bus.ifname}: {why}")
    at_work = [
        slave for slave in slaves
        if slave.at_work and not (slave.position in ours and _is_ours(bus, slave, ours[slave.position]))
    ]  # fmt: skip
    if at_work and not force:
        where = ", ".join(f"{slave.position} in {slave.status.state.name}" for slave in at_work)
        raise BusError(
            f"{bus.ifname} has slaves at work that are not Bota sensors (position {where}): name the "
            "interface that the sensor is connected to, or stop their master; --force takes them to PREOP"
        )
    found = []
    for slave in slaves:
        check_interrupt()
        stopped = _stopped(bus, slave, check_interrupt) if slave.at_work else slave
        found.append(with_sii(bus, stopped, check_interrupt))
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
        content = sii.decode(read_image(bus, slave.position, check_interrupt))
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
        return bus.finish(read_sii(registers, position, word, words, owner), check_interrupt)

    return sii.read_image(read)


class OtherSlaves:
    """The slaves beside the sensors: only their AL state is read, in turn."""

    def __init__(self, bus: Bus, slaves: Sequence[Slave]) -> None:
        self._bus = bus
        self._slaves = slaves
        # `others` of the `describe` reply; kept up to date.
        self.rows: list[dict[str, Any]] = [slave.as_json() for slave in slaves[:_MOST_LISTED]]
        self._unanswered = [0] * len(self.rows)
        self._turn = -1

    def check_next(self) -> Steps[None]:
        """Read the AL state of the next one, with one datagram."""
        if not self.rows:
            return
        self._turn = turn = (self._turn + 1) % len(self.rows)
        row, slave = self.rows[turn], self._slaves[turn]
        data = yield from self._bus.read_at(slave.position, reg.AL_STATUS, reg.AL_STATUS_SIZE)
        if data:
            if row["state"] == _ABSENT:
                log.info("%s is back", slave)
            row["state"], self._unanswered[turn] = AlStatus.parse(data).state.name, 0
            return
        self._unanswered[turn] += 1
        if self._unanswered[turn] == _ABSENT_AFTER:
            row["state"] = _ABSENT
            log.warning("%s does not answer any more", slave)


def _sync_managers(bus: Bus, position: int) -> list[tuple[int, ...]]:
    data = bus.read_surely_at(position, reg.SYNC_MANAGER, 4 * reg.SYNC_MANAGER_SIZE)
    return list(reg.SYNC_MANAGER_LAYOUT.iter_unpack(data))


def _has_sensors_managers(bus: Bus, position: int) -> bool:
    *others, inputs = ((start, length) for start, length, *_ in _sync_managers(bus, position))
    return tuple(others) == _MAILBOXES_AND_OUTPUTS and inputs in [(_INPUTS, size) for size in LAYOUTS]


def _is_ours(bus: Bus, slave: Slave, kind: Kind | None) -> bool:
    """Whether it is of this kind, if any, and has no outputs; in BOOT nobody knows."""
    kinds = [control for _, length, control, *_ in _sync_managers(bus, slave.position) if length]
    has_outputs = any(control & reg.SM_WRITE and not control & reg.SM_MAILBOX for control in kinds)
    if has_outputs or slave.status.state is AlState.BOOT:
        return False
    content = kind and with_sii(bus, slave).sii
    return kind is None or (content is not None and (content["vendor"], content["product"]) == kind)


def _stopped(bus: Bus, slave: Slave, check_interrupt: CheckInterrupt) -> Slave:
    """Take a slave that is not Bota's to PREOP, as `force` permits."""
    position = slave.position
    bus.write_surely_at(position, reg.AL_CONTROL, AlStatus(AlState.PREOP, error=True, code=0).acknowledge())
    deadline = Deadline(bus.clock, STATE_S[AlState.PREOP])
    while (now := look_at(bus, position)).at_work:
        check_interrupt()
        if deadline.passed:
            raise BusError(f"slave {position} on {bus.ifname} stays in {now.status}: switch it off")
        bus.clock.sleep(_PAUSE_S)
    log.warning("the slave at position %d of %s was taken to %s", position, bus.ifname, now.status)
    return now
