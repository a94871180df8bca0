"""What the kernel says of a network interface, and what it needs to carry EtherCAT frames. Needs no rights.

Asked by netlink (linux/rtnetlink.h), not of /sys, which shows the namespace it was mounted in. Server, tool
and doctor ask `network_trouble` whether addresses and routes make it one to send no EtherCAT frames on.
"""

from __future__ import annotations

import difflib
import ipaddress
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Final, NamedTuple

from ethercat_server.errors import InterfaceError

LEAST_MTU: Final = 1500  # bytes: an EtherCAT frame may be as long as any Ethernet frame
CHECK_CABLE: Final = "check cable and power"
# The option that has the server or a program use an interface with the default route or a leased address.
ALLOW_IP: Final = "--allow-ip"
ALLOW_IP_HELP: Final = "use IFACE although it has the machine's default route or an IP address by DHCP"

_GET_LINK, _GET_ADDRESS, _GET_ROUTE = 18, 22, 26
_REQUEST, _DUMP = 0x1, 0x300
_ERROR, _DONE = 2, 3
_HEADER: Final = struct.Struct("=IHHII")  # length, type, flags, sequence number, port
_ATTRIBUTE: Final = struct.Struct("=HH")
_TYPE: Final = 0x3FFF
_BUFFER: Final = 65536
_LINK: Final = struct.Struct("=BxHiII")  # family, type, index, flags, change mask
_IFLA_ADDRESS, _IFLA_MTU, _IFLA_MASTER, _IFLA_CARRIER = 1, 4, 10, 33
_IFF_UP, _IFF_LOOPBACK, _IFF_RUNNING = 0x1, 0x8, 0x40
_ADDRESS: Final = struct.Struct("=BBBBI")  # family, length of the prefix, flags, scope, interface
_IFA_ADDRESS, _IFA_LOCAL = 1, 2
_IFA_F_PERMANENT: Final = 0x80
# Family, length of the destination, of the source, TOS, table, who made it, scope, kind, flags.
_ROUTE: Final = struct.Struct("=BBBBBBBBI")
_RTA_DST, _RTA_OIF = 1, 4
_MAIN_TABLE: Final = 254
_MADE_BY_KERNEL: Final = 2
_LINK_SCOPE: Final = 253
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)


class Interface(NamedTuple):
    """An interface as it is now."""

    ifindex: int
    flags: int
    mtu: int
    master: int  # index of the bridge or bond that it is part of, 0 if none
    carrier: bool  # what the driver says of the link
    address: bytes  # of the hardware

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
        (_, _, index, flags, _), found = next(
            _ask(_GET_LINK, _LINK, 0, 0, socket.if_nametoindex(ifname), 0, 0)
        )
    except (OSError, struct.error):
        names = [name for _, name in socket.if_nameindex()]
        close = difflib.get_close_matches(ifname, [*names, "virtual"], n=1)
        raise InterfaceError(
            f"no network interface {ifname!r} on this machine: there are {', '.join(names)}, and 'virtual' "
            f"for a virtual sensor{f'; did you mean {close[0]!r}?' if close else ''}"
        ) from None
    mtu, master, carrier = (
        int.from_bytes(found.get(name, b""), sys.byteorder)
        for name in (_IFLA_MTU, _IFLA_MASTER, _IFLA_CARRIER)
    )
    return Interface(index, flags, mtu, master, bool(carrier), found.get(_IFLA_ADDRESS, b""))


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


class Routes(NamedTuple):
    """Addresses and routes on an interface."""

    addresses: tuple[str, ...] = ()  # with the length of their prefix; link-local ones are not among them
    link_local: tuple[str, ...] = ()  # those that every interface may give itself, without a network
    default: bool = False  # the machine's default route goes here
    others: tuple[str, ...] = ()  # destinations of the routes that somebody made
    # Those of the addresses that a network gave for some time: DHCP, or an IPv6 router.
    leased: tuple[str, ...] = ()

    def __str__(self) -> str:
        """What makes it part of a network; empty if nothing does."""
        return ", ".join(("default route",) * self.default + self.addresses)


def find_routes(ifname: str) -> Routes:
    """What is on `ifname` now; OSError if the kernel does not say."""
    index, default = socket.if_nametoindex(ifname), False
    addresses: list[str] = []
    link_local: list[str] = []
    leased: list[str] = []
    others: list[str] = []
    try:
        for (family, length, flags, scope, its), found in _ask(_GET_ADDRESS, _ADDRESS, 0, 0, 0, 0, 0):
            if its == index and family in _FAMILIES:
                raw = found.get(_IFA_LOCAL) or found[_IFA_ADDRESS]
                there = link_local if scope == _LINK_SCOPE else addresses
                there.append(f"{ipaddress.ip_address(raw)}/{length}")
                if there is addresses and not flags & _IFA_F_PERMANENT:
                    leased.append(addresses[-1])
        for (family, length, _, _, table, made_by, *_), found in _ask(_GET_ROUTE, _ROUTE, *(0,) * 9):
            goes = int.from_bytes(found.get(_RTA_OIF, b""), sys.byteorder)
            if goes != index or table != _MAIN_TABLE or family not in _FAMILIES:
                continue
            default = default or not length
            if length and made_by != _MADE_BY_KERNEL:
                others.append(f"{ipaddress.ip_address(found[_RTA_DST])}/{length}")
    except (LookupError, ValueError, struct.error) as error:
        raise OSError(f"unknown answer: {error}") from error
    return Routes(tuple(addresses), tuple(sorted(link_local)), default, tuple(others), tuple(leased))


def network_trouble(ifname: str, routes: Routes) -> str | None:
    """Why no EtherCAT frame belongs on `ifname`, and what to do; None if it may be used."""
    other = "name the one that the sensor is connected to ('ethercat-sensor adapters' lists them)"
    anyway = f"{ALLOW_IP} uses it all the same"
    if routes.default:
        return (
            f"{ifname} has the machine's default route, so it is no interface for a sensor: {other}; {anyway}"
        )
    if routes.leased:
        return (
            f"{ifname} has the IP address {routes.leased[0]} by DHCP, so it is part of a network: {other}, "
            f"or, if only the sensor is on it, 'sudo ip address flush dev {ifname}'; {anyway}"
        )
    return None


def _ask(
    kind: int, layout: struct.Struct, *values: int
) -> Iterator[tuple[tuple[int, ...], dict[int, bytes]]]:
    """The kernel's answers: fixed part and attributes, by type. OSError or struct.error if it refuses."""
    flags = _REQUEST if kind == _GET_LINK else _REQUEST | _DUMP
    request = _HEADER.pack(_HEADER.size + layout.size, kind, flags, 0, 0) + layout.pack(*values)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as asked:
        asked.setblocking(False)  # the kernel answers before send returns
        asked.send(request)
        while True:
            data = asked.recv(_BUFFER)
            at = 0
            while at + _HEADER.size <= len(data):
                size, found, *_ = _HEADER.unpack_from(data, at)
                if found == _DONE:
                    return
                if found == _ERROR or size < _HEADER.size:
                    raise OSError("the kernel refuses the request")
                body = data[at + _HEADER.size : at + size]
                yield layout.unpack_from(body), _attributes(body[layout.size :])
                at += size + 3 & ~3
            if kind == _GET_LINK:
                return


def _attributes(data: bytes) -> dict[int, bytes]:
    found, at = {}, 0
    while at + _ATTRIBUTE.size <= len(data):
        length, attribute = _ATTRIBUTE.unpack_from(data, at)
        found[attribute & _TYPE] = data[at + _ATTRIBUTE.size : at + length]
        at += max(_ATTRIBUTE.size, length + 3 & ~3)
    return found
