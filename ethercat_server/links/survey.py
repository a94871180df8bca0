"""The network interfaces of this machine, and the careful look for sensors on one of them."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, Final, NamedTuple

from ethercat_server.ethercat.nic.ip import Routes, find_routes
from ethercat_server.links import direct
from ethercat_server.links.holder import Holder, find_holder
from ethercat_server.links.interfaces import is_local, kind, open_routes
from ethercat_server.links.promiscuity import promiscuity_kept
from ethercat_server.sensor.scan import Slave, look_safely

_IFF_UP, _IFF_LOOPBACK = 0x1, 0x8
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


def look_on(ifname: str) -> list[Slave]:
    """The slaves on `ifname`, all left in the state they are in; ServerError if it cannot be looked at.

    Frames of another master are waited for first; nothing is asked if there are some.
    """
    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(promiscuity_kept(ifname))
        return look_safely(direct.open_bus(ifname, cleanup), lambda: None)
