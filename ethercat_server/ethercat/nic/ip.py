"""IP on an interface: addresses and routes, and whether that makes it one to send no EtherCAT frames on.

Server, tool and doctor ask `network_trouble`: the one place that decides it.
"""

from __future__ import annotations

import ipaddress
import socket
import struct
import sys
from dataclasses import dataclass
from typing import Final

from ethercat_server.ethercat.nic.netlink import GET_ADDRESS, GET_ROUTE, ask

ALLOW_IP: Final = "--allow-ip"
"""The option that has the server or a program use such an interface all the same."""
ALLOW_IP_HELP: Final = "use IFACE although it has the machine's default route or an IP address by DHCP"

_ADDRESS: Final = struct.Struct("=BBBBI")
"""Family, length of the prefix, flags, scope, interface."""
_IFA_ADDRESS, _IFA_LOCAL = 1, 2
_ROUTE: Final = struct.Struct("=BBBBBBBBI")
"""Family, length of the destination, of the source, TOS, table, who made it, scope, kind, flags."""
_RTA_DST, _RTA_OIF = 1, 4
_IFA_F_PERMANENT: Final = 0x80
_MAIN_TABLE: Final = 254
_MADE_BY_KERNEL: Final = 2
_LINK_SCOPE: Final = 253
_FAMILIES: Final = (socket.AF_INET, socket.AF_INET6)


@dataclass(frozen=True)
class Routes:
    """Addresses and routes on an interface."""

    addresses: tuple[str, ...] = ()
    """With the length of their prefix; link-local ones are not among them."""
    link_local: tuple[str, ...] = ()
    """Those that every interface may give itself, without a network."""
    default: bool = False
    """The machine's default route goes here."""
    others: tuple[str, ...] = ()
    """Destinations of the routes that somebody made."""
    leased: tuple[str, ...] = ()
    """Those of the addresses that a network gave for some time: DHCP, or an IPv6 router."""

    def __str__(self) -> str:
        """What makes it part of a network; empty if nothing does."""
        return ", ".join(("default route",) * self.default + self.addresses)


def find_routes(ifname: str) -> Routes:
    """What is on `ifname` now; OSError if the kernel does not say."""
    try:
        return _find_routes(ifname)
    except (LookupError, ValueError, struct.error) as error:
        raise OSError(f"unknown answer: {error}") from error


def _find_routes(ifname: str) -> Routes:
    index = socket.if_nametoindex(ifname)
    addresses: list[str] = []
    link_local: list[str] = []
    leased: list[str] = []
    for (family, length, flags, scope, its), found in ask(
        GET_ADDRESS, _ADDRESS, 0, 0, 0, 0, 0, all_of_them=True
    ):
        if its == index and family in _FAMILIES:
            raw = found.get(_IFA_LOCAL) or found[_IFA_ADDRESS]
            there = link_local if scope == _LINK_SCOPE else addresses
            there.append(f"{ipaddress.ip_address(raw)}/{length}")
            if there is addresses and not flags & _IFA_F_PERMANENT:
                leased.append(addresses[-1])
    default, others = False, []
    for row, found in ask(GET_ROUTE, _ROUTE, *(0,) * 9, all_of_them=True):
        family, length, _, _, table, made_by, *_ = row
        goes = int.from_bytes(found.get(_RTA_OIF, b""), sys.byteorder)
        if goes != index or table != _MAIN_TABLE or family not in _FAMILIES:
            continue
        default = default or not length
        if length and made_by != _MADE_BY_KERNEL:
            others.append(f"{ipaddress.ip_address(found[_RTA_DST])}/{length}")
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
