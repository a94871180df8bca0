"""Looks at a bus before it is scanned: a scan takes every slave to INIT, whosever it is.

Looking changes nothing on the bus: frames of other masters are counted, registers are read. Not even the SII
(EEPROM) of a slave in SAFEOP or OP is read, for that takes writes to its controller; what is Bota's is told
from the sync managers.
"""

from __future__ import annotations

import struct
from typing import Final

from ethercat_server.errors import BusError
from ethercat_server.ethercat.backend import CheckInterrupt, SlaveIdentity
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState, AlStatus
from protocol.pdo import LAYOUTS

_LISTEN_S: Final = 0.1
_MASTER_FRAMES: Final = 3
"""Frames in this time that are a master's cycle; fewer may be the last ones of a server that was killed."""
_TIMEOUT_S: Final = 0.02
_ATTEMPTS: Final = 3
_MAILBOXES_AND_OUTPUTS: Final = ((0x1000, 128), (0x1080, 128), (0x1100, 1))
"""Start and length of a Bota sensor's sync managers 0 to 2."""
_INPUTS: Final = 0x1180
_SYNC_MANAGER: Final = struct.Struct("<HH4x")
_ABOVE_PREOP: Final = AlState.SAFEOP | AlState.OP


def scan(bus: Bus, check_interrupt: CheckInterrupt, *, force: bool = False) -> list[SlaveIdentity]:
    """Find the slaves and take them to PREOP (see `Bus.scan`).

    BusError if that would stop somebody else's machine, unless `force`: if another master is sending, or a
    slave that is not Bota's is in SAFEOP or OP.
    """
    if not force:
        _check_no_master(bus)
        check_interrupt()
        _check_slaves(bus)
    return bus.scan(check_interrupt)


def may_be_read(bus: Bus, position: int, al: AlStatus) -> bool:
    """Whether reading the SII of the slave at `position` disturbs nobody."""
    return not al.raw_state & _ABOVE_PREOP or _is_bota(bus, position)


def _check_no_master(bus: Bus) -> None:
    if (count := bus.listen(_LISTEN_S)) >= _MASTER_FRAMES:
        raise BusError(
            f"another EtherCAT master is sending on {bus.ifname} ({count} frames in {_LISTEN_S:g} s): stop "
            "it, or name the interface that the sensor is connected to; --force takes its slaves over"
        )


def _check_slaves(bus: Bus) -> None:
    answers = (bus.read_all(reg.AL_STATUS, 1, _TIMEOUT_S) for _ in range(_ATTEMPTS))
    count, states = next((answer for answer in answers if answer is not None), (0, b"\0"))
    if not states[0] & _ABOVE_PREOP:
        return
    found = []
    for position in range(count):
        data = bus.read_surely_at(position, reg.AL_STATUS, reg.AL_STATUS_SIZE)
        status = AlStatus.parse(data)
        if not may_be_read(bus, position, status):
            found.append(f"{position} in {status.state.name}")
    if found:
        raise BusError(
            f"{bus.ifname} has slaves at work that are no Bota sensors (position {', '.join(found)}): a scan "
            "would stop them; name the interface that the sensor is connected to, or stop their master; "
            "--force takes every slave to INIT"
        )


def _is_bota(bus: Bus, position: int) -> bool:
    data = bus.read_surely_at(position, reg.SYNC_MANAGER, 4 * reg.SYNC_MANAGER_SIZE)
    *others, inputs = _SYNC_MANAGER.iter_unpack(data)
    return tuple(others) == _MAILBOXES_AND_OUTPUTS and inputs in [(_INPUTS, size) for size in LAYOUTS]
