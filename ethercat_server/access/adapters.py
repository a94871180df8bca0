"""The network interfaces of this machine, as the kernel describes them by pyroute2."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from ethercat_server.access.holder import Holder, find_holder
from ethercat_server.ethercat.nic import Routes, find_routes
from ethercat_server.process.signals import signals_held_back

_IFF_UP, _IFF_LOOPBACK, _IFF_PROMISC = 0x1, 0x8, 0x100
_ETHERNET: Final = 1
_CARDS: Final = frozenset({"", "veth"})
"""Kinds that a sensor can be connected to: network cards, and what tests use for one."""


class Adapter(NamedTuple):
    """A network interface."""

    name: str
    kind: str = ""
    """Of a virtual one, such as veth or bridge; empty for a network card."""
    address: str | None = None
    up: bool = True
    carrier: bool = True
    loopback: bool = False
    ethernet: bool = True
    """Wired Ethernet, or a virtual interface like it."""
    part_of_others: bool = False
    """It belongs to a bridge or bond, or carries VLANs."""
    routes: Routes = Routes()
    holder: Holder | None = None
    """The EtherCAT master that uses it."""

    @property
    def state(self) -> str:
        """Of the link, as text."""
        return "down" if not self.up else "up" if self.carrier else "up, no carrier"

    @property
    def unfit(self) -> str | None:
        """Why nobody should look for a sensor on it; None if it is a candidate."""
        if self.loopback:
            return "loopback"
        if not self.ethernet or self.kind not in _CARDS:
            return self.kind or "no wired Ethernet"
        if self.part_of_others:
            return "part of a bridge, bond or VLAN"
        if not self.up or not self.carrier:
            return self.state if self.up else f"down ('sudo ip link set {self.name} up' to have it looked at)"
        return str(self.routes) or None


def adapters() -> list[Adapter]:
    """All interfaces of this machine. Nothing is sent on them."""
    with open_routes() as route:
        rows = list(route.get_links())
    carrying = {row.get_attr("IFLA_LINK") for row in rows if is_local(row)}
    return [_adapter(row, carrying) for row in rows]


def _adapter(row: Any, carrying: set[int]) -> Adapter:
    name, up = row.get_attr("IFLA_IFNAME"), bool(row["flags"] & _IFF_UP)
    try:
        routes = find_routes(name)
    except OSError:  # it has just gone
        routes = Routes()
    wireless = any(Path(f"/sys/class/net/{name}/{mark}").exists() for mark in ("wireless", "phy80211"))
    return Adapter(
        name,
        kind=kind(row),
        address=row.get_attr("IFLA_ADDRESS"),
        up=up,
        carrier=up and row.get_attr("IFLA_CARRIER") == 1,
        loopback=bool(row["flags"] & _IFF_LOOPBACK),
        ethernet=row["ifi_type"] == _ETHERNET and not wireless,
        part_of_others=bool(row.get_attr("IFLA_MASTER")) or row["index"] in carrying,
        routes=routes,
        holder=find_holder(name),
    )


@contextlib.contextmanager
def promiscuity_kept(ifname: str) -> Iterator[None]:
    """Restore promiscuous mode to off afterwards if it was off before: SOEM switches it on and leaves it."""

    def is_promiscuous() -> bool | None:
        with open_routes() as route:
            flags = {row.get_attr("IFLA_IFNAME"): row["flags"] for row in route.get_links()}.get(ifname)
        return None if flags is None else bool(flags & _IFF_PROMISC)

    before = is_promiscuous()
    from pyroute2.netlink.exceptions import NetlinkError  # noqa: PLC0415 - loaded by now

    try:
        yield
    finally:
        if before is False and is_promiscuous():
            with open_routes() as route, contextlib.suppress(NetlinkError, OSError):
                route.link("set", index=socket.if_nametoindex(ifname), flags=0, change=_IFF_PROMISC)


@contextlib.contextmanager
def open_routes() -> Iterator[Any]:
    """pyroute2's IPRoute. Signals wait meanwhile: its import and its event loop do not bear an exception."""
    with signals_held_back():
        from pyroute2 import IPRoute  # noqa: PLC0415 - takes a moment

        with IPRoute() as route:
            yield route


def kind(row: Any) -> str:
    """Of a virtual interface, such as veth or bridge; empty for a network card."""
    info = row.get_attr("IFLA_LINKINFO")
    return (info.get_attr("IFLA_INFO_KIND") if info else None) or ""


def is_local(row: Any) -> bool:
    """Whether what it stands on is an interface of this namespace: a veth's other end is not below it."""
    return row.get_attr("IFLA_LINK_NETNSID") is None and kind(row) != "veth"
