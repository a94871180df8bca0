"""What the kernel says of a network interface, and what it needs to carry EtherCAT frames. Needs no rights.

Asked by netlink (linux/rtnetlink.h), not of /sys, which shows the namespace it was mounted in.
"""

from __future__ import annotations

import difflib
import socket
import struct
import sys
from typing import Final, NamedTuple

from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.nic.netlink import GET_LINK, ask

LEAST_MTU: Final = 1500
"""Bytes: an EtherCAT frame may be as long as any Ethernet frame."""
CHECK_CABLE: Final = "check cable and power"

_IFLA_ADDRESS, _IFLA_MTU, _IFLA_MASTER, _IFLA_CARRIER = 1, 4, 10, 33
_LINK: Final = struct.Struct("=BxHiII")
"""Family, type, index, flags, change mask."""
_IFF_UP, _IFF_LOOPBACK, _IFF_RUNNING = 0x1, 0x8, 0x40


class Interface(NamedTuple):
    """An interface as it is now."""

    ifindex: int
    flags: int
    mtu: int
    master: int
    """Index of the bridge or bond that it is part of, 0 if none."""
    carrier: bool
    """What the driver says of the link."""
    address: bytes
    """Of the hardware."""

    @property
    def is_up(self) -> bool:
        """Whether it is up."""
        return bool(self.flags & _IFF_UP)

    @property
    def is_loopback(self) -> bool:
        """Whether it is the loopback interface."""
        return bool(self.flags & _IFF_LOOPBACK)

    @property
    def has_carrier(self) -> bool:
        """Whether it is linked, and ready to send: the flag may follow the driver a second later."""
        return self.carrier and bool(self.flags & _IFF_RUNNING)


def look_up(ifname: str) -> Interface:
    """The interface named `ifname`; InterfaceError if there is none."""
    try:
        return _answer(socket.if_nametoindex(ifname))
    except (OSError, struct.error):
        names = [name for _, name in socket.if_nameindex()]
        close = difflib.get_close_matches(ifname, [*names, "virtual"], n=1)
        raise InterfaceError(
            f"no network interface {ifname!r} on this machine: there are {', '.join(names)}, and 'virtual' "
            f"for a virtual sensor{f'; did you mean {close[0]!r}?' if close else ''}"
        ) from None


def trouble(ifname: str) -> str | None:
    """What keeps frames from passing over `ifname`, and what to do; None if it is not the interface."""
    found = look_up(ifname)
    if not found.is_up:
        return f"{ifname} is down: bring it up with 'sudo ip link set {ifname} up'"
    if found.master:
        return (
            f"{ifname} is part of {_name(found.master)} (a bridge or bond), which takes its frames: remove "
            f"it with 'sudo ip link set {ifname} nomaster', or use another interface"
        )
    if found.mtu < LEAST_MTU:
        return (
            f"{ifname} has an MTU of {found.mtu} bytes, too few for EtherCAT: "
            f"'sudo ip link set {ifname} mtu {LEAST_MTU}'"
        )
    if not found.has_carrier:
        return f"{ifname} has no carrier: check the cable, the PoE injector and its power supply"
    return None


def why_silent(ifname: str) -> str:
    """Why no frame comes back, as far as the interface knows, and what to do."""
    try:
        return trouble(ifname) or CHECK_CABLE
    except InterfaceError as error:
        return str(error)


def check_present(ifname: str, ifindex: int) -> None:
    """Raise InterfaceError unless `ifname` is still the interface that was opened."""
    if (ifindex, ifname) not in socket.if_nameindex():
        raise InterfaceError(f"the interface {ifname} has disappeared: connect it and start the server again")


def _name(index: int) -> str:
    try:
        return socket.if_indextoname(index)
    except OSError:
        return f"interface {index}"


def _answer(index: int) -> Interface:
    """What the kernel answers about the interface `index`; OSError or struct.error if it does not."""
    (_, _, index, flags, _), found = next(ask(GET_LINK, _LINK, 0, 0, index, 0, 0))
    mtu, master, carrier = (
        int.from_bytes(found.get(name, b""), sys.byteorder)
        for name in (_IFLA_MTU, _IFLA_MASTER, _IFLA_CARRIER)
    )
    return Interface(index, flags, mtu, master, bool(carrier), found.get(_IFLA_ADDRESS, b""))
