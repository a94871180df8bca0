"""Scans a bus: finds the sensors, leaves the others alone, and takes the sensors to PREOP."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import CheckInterrupt
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.clock import Deadline
from ethercat_server.ethercat.master.datagrams import DatagramMaster
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave import times
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.sensor.look import Slave, check_no_master, look, look_at, with_sii

_PAUSE_S: Final = 0.002
_ACKNOWLEDGE: Final = 0x10
_MAILBOX_BYTES: Final = range(16, 1487)

log = logging.getLogger(__name__)


def look_safely(bus: Bus, check_interrupt: CheckInterrupt, *, force: bool = False) -> list[Slave]:
    """All slaves on the wire.

    BusError if using the bus would stop somebody else's machine: if another master is sending, or a slave
    that is not Bota's is in SAFEOP, OP or BOOT. With `force`, such slaves are taken to PREOP instead.
    """
    if not force:
        check_no_master(bus)
    check_interrupt()
    slaves = look(bus, check_interrupt)
    at_work = [slave for slave in slaves if slave.at_work]
    if at_work and not force:
        where = ", ".join(f"{slave.position} in {slave.status.state.name}" for slave in at_work)
        raise BusError(
            f"{bus.ifname} has slaves at work that are no Bota sensors (position {where}): name the "
            "interface that the sensor is connected to, or stop their master; --force takes them to PREOP"
        )
    found = []
    for slave in slaves:
        check_interrupt()
        stopped = _stopped(bus, slave, check_interrupt) if slave.at_work else slave
        found.append(with_sii(bus, stopped, check_interrupt))
    return found


def scan(bus: Bus, slaves: Sequence[Slave], check_interrupt: CheckInterrupt, *, again: bool = False) -> None:
    """Take these slaves to PREOP, numbered in this order. `slaves` has all that are on the wire.

    pysoem is the master where all are sensors; where there are others, they are not written to. `again`:
    after a failure, with the master that repeats what lost frames spoil.
    """
    numbered = [slave for slave in slaves if slave.is_sensor] or list(slaves)
    for slave in numbered:
        _check_sii(bus.ifname, slave)
    bus.spare = DatagramMaster(bus, [slave.sii for slave in slaves])
    own = None if again or len(numbered) < len(slaves) else bus.backend.master
    bus.scan(own or bus.spare, [slave.position for slave in numbered], check_interrupt)


def _check_sii(ifname: str, slave: Slave) -> None:
    """BusError if nothing is known of it, or if it says what no master can do: pysoem would not notice."""
    if slave.sii is None:
        raise BusError(unreadable(ifname, slave))
    sizes = [size for _, size in slave.sii["mailboxes"].values()]
    if any(sizes) and not all(size in _MAILBOX_BYTES for size in sizes):
        raise BusError(
            f"the SII (EEPROM) of the slave at position {slave.position} of {ifname} has mailboxes of "
            f"{' and '.join(map(str, sizes))} bytes, which no frame can carry: its EEPROM is damaged"
        )


def unreadable(ifname: str, slave: Slave) -> str:
    """The sentence about a slave of which nothing is known."""
    return (
        f"the SII (EEPROM) of the slave at position {slave.position} of {ifname} cannot be read, so it does "
        "not say what it is: power it off and on; if that does not help, its EEPROM is damaged"
    )


def _stopped(bus: Bus, slave: Slave, check_interrupt: CheckInterrupt) -> Slave:
    """Take a slave that is not Bota's, and that is to be taken over, to PREOP."""
    position = slave.position
    request = (AlState.PREOP | _ACKNOWLEDGE).to_bytes(2, "little")
    bus.write_surely_at(position, reg.AL_CONTROL, request)
    deadline = Deadline(bus.clock, times.STATE_S[AlState.PREOP])
    while (now := look_at(bus, position)).at_work:
        check_interrupt()
        if deadline.passed:
            raise BusError(f"slave {position} on {bus.ifname} stays in {now.status}: switch it off")
        bus.clock.sleep(_PAUSE_S)
    log.warning("the slave at position %d of %s was taken to %s", position, bus.ifname, now.status)
    return now
