"""What needs a bus before any sensor is at work: the EEPROMs of its slaves, the objects of a foreign one.

Every slave stays in the state that it is in.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator

from ethercat_server.access.adapters import promiscuity_kept
from ethercat_server.errors import BusError, UsageError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.datagrams import ByPosition
from ethercat_server.ethercat.open_bus import open_bus
from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.slave.al import AlState
from ethercat_server.ethercat.slave.coe import MailboxSdo
from ethercat_server.sensor.guard import GuardedSdo
from ethercat_server.sensor.scan import Slave, look_safely, read_image
from ethercat_server.sensor.sensor import Found, Identity
from ethercat_server.virtual_sensor.virtual_bus import VIRTUAL_INTERFACE, VirtualBus


@contextlib.contextmanager
def open_interface(ifname: str, *, allow_ip: bool = False) -> Iterator[Bus]:
    """The open bus on `ifname`, or on a virtual bus for `virtual`."""
    with contextlib.ExitStack() as cleanup:
        if ifname == VIRTUAL_INTERFACE:
            ifname = cleanup.enter_context(VirtualBus()).ifname
        yield cleanup.enter_context(open_bus(ifname, allow_ip=allow_ip))


def look_on(ifname: str) -> list[Slave]:
    """The slaves on `ifname`; ServerError if it cannot be looked at.

    Frames of another master are waited for first; nothing is asked if there are some.
    """
    with promiscuity_kept(ifname), open_interface(ifname) as bus:
        return look_safely(bus, lambda: None)


def read_images(ifname: str, *, force: bool, allow_ip: bool) -> dict[int, bytes | BusError]:
    """The SII of every slave on the wire, of any vendor, by position."""
    with open_interface(ifname, allow_ip=allow_ip) as bus:
        images: dict[int, bytes | BusError] = {}
        for slave in look_safely(bus, lambda: None, force=force):
            try:
                images[slave.position] = read_image(bus, slave.position)
            except BusError as error:
                images[slave.position] = error
        return images


def open_slave(bus: Bus, wanted: str) -> tuple[Found, GuardedSdo]:
    """The slave POSITION:NAME and its objects, through the mailboxes that its own master has set up.

    Nothing is written but its mailbox. UsageError if there is no such slave, BusError if it is in INIT.
    """
    place, _, name = wanted.partition(":")
    slaves = look_safely(bus, lambda: None)
    there = "; ".join(f"{slave.position}:{slave.name}" for slave in slaves)
    slave = next((each for each in slaves if (str(each.position), each.name) == (place, name)), None)
    if slave is None:
        raise UsageError(f"no slave is {wanted!r}, as POSITION:NAME: there are {there}")
    if not slave.has_coe:
        raise UsageError(f"slave {wanted} has no CoE mailbox, and so no objects")
    if slave.status.state in (AlState.INIT, AlState.BOOT):
        raise BusError(
            f"slave {wanted} is in {slave.status.state.name}, where its objects cannot be read: have its own "
            "master take it to PREOP"
        )
    rows = bus.read_surely_at(slave.position, reg.SYNC_MANAGER, 2 * reg.SYNC_MANAGER_SIZE)
    out, back = struct.unpack_from("<HH", rows), struct.unpack_from("<HH", rows, reg.SYNC_MANAGER_SIZE)
    serial = slave.sii["serial"] if slave.sii else 0
    found = Found(slave.position, Identity(slave.name, serial, "", ""), "slave")
    return found, GuardedSdo(MailboxSdo(ByPosition(bus), slave.position, (out, back)))
