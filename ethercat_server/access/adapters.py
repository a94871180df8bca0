"""The network interfaces of this machine, as the kernel describes them by pyroute2; and which process uses
one as an EtherCAT master, with the TCP port it listens on.

See `packet_sockets`; listening TCP sockets are in /proc/net too. Of another user's process, and in another
network namespace, neither is visible: then the server that programs use by default is asked for
its interface.
"""

from __future__ import annotations

import contextlib
import ipaddress
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.errors import ProtocolError, UnreachableError
from bota_ethercat.program.server_choice import default_server
from ethercat_server.errors import InterfaceError, ServerError
from ethercat_server.ethercat.nic import (
    Routes,
    find_routes,
    look_up,
    master_sockets,
    own_name,
    table,
    users_of,
)
from ethercat_server.process.signals import signals_held_back

_IFF_UP, _IFF_LOOPBACK = 0x1, 0x8
_ETHERNET: Final = 1
# Kinds that a sensor can be connected to: network cards, and what tests use for one.
_CARDS: Final = frozenset({"", "veth"})
_LISTEN: Final = 0x0A


class Holder(NamedTuple):
    """A process that uses an interface."""

    pid: int | None  # None if it is not visible to this user
    name: str
    address: Address | None  # the TCP address it listens on; None if it does not, or if that is not visible

    def __str__(self) -> str:
        if self.pid is not None:
            return f"process {self.pid} ({self.name})"
        return "another EtherCAT master" if self.address is None else self.name


class Adapter(NamedTuple):
    """A network interface."""

    name: str
    ifindex: int = 0
    kind: str = ""  # of a virtual one, such as veth or bridge; empty for a network card
    address: str | None = None
    up: bool = True
    carrier: bool = True
    loopback: bool = False
    ethernet: bool = True  # wired Ethernet, or a virtual interface like it
    master: str = ""  # bridge or bond that it is a part of
    upper: tuple[str, ...] = ()  # interfaces that stand on it, such as VLANs
    counters: Mapping[str, int] = {}
    routes: Routes = Routes()
    holder: Holder | None = None  # the EtherCAT master that uses it

    @property
    def state(self) -> str:
        return "down" if not self.up else "up" if self.carrier else "up, no carrier"

    @property
    def unfit(self) -> str | None:
        """Why nobody should look for a sensor on it; None if it is a candidate."""
        if self.loopback:
            return "loopback"
        if not self.ethernet or self.kind not in _CARDS:
            return self.kind or "no wired Ethernet"
        if self.master or self.upper:
            return "part of a bridge, bond or VLAN"
        if not self.up or not self.carrier:
            return self.state if self.up else f"down ('sudo ip link set {self.name} up' to have it looked at)"
        return str(self.routes) or None


def adapters() -> list[Adapter]:
    """All interfaces of this machine, with their routes and users. Nothing is sent on them."""
    found = []
    for row in links():
        with contextlib.suppress(OSError):  # it has just gone
            found.append(row._replace(routes=find_routes(row.ifindex), holder=find_holder(row.name)))
    return found


def links() -> list[Adapter]:
    """All interfaces of this machine, without their routes and users."""
    # Signals wait meanwhile: pyroute2's import and its event loop do not bear an exception.
    with signals_held_back():
        from pyroute2 import IPRoute  # noqa: PLC0415 - takes a moment

        with IPRoute() as route:
            rows = list(route.get_links())
    return [_link(row, rows) for row in rows]


def _link(row: Any, rows: Sequence[Any]) -> Adapter:
    name, up = row.get_attr("IFLA_IFNAME"), bool(row["flags"] & _IFF_UP)
    stats = row.get_attr("IFLA_STATS64") or row.get_attr("IFLA_STATS") or {}
    wireless = any(Path(f"/sys/class/net/{name}/{mark}").exists() for mark in ("wireless", "phy80211"))
    return Adapter(
        name,
        ifindex=row["index"],
        kind=_kind(row),
        address=row.get_attr("IFLA_ADDRESS"),
        up=up,
        carrier=up and row.get_attr("IFLA_CARRIER") == 1,
        loopback=bool(row["flags"] & _IFF_LOOPBACK),
        ethernet=row["ifi_type"] == _ETHERNET and not wireless,
        master=next((_name(each) for each in rows if each["index"] == row.get_attr("IFLA_MASTER")), ""),
        upper=tuple(_name(each) for each in rows if _stands_on(each, row["index"])),
        counters={key: int(stats[key]) for key in stats.keys() if isinstance(stats[key], int)},  # noqa: SIM118
    )


def _name(row: Any) -> str:
    return str(row.get_attr("IFLA_IFNAME"))


def _kind(row: Any) -> str:
    info = row.get_attr("IFLA_LINKINFO")
    return (info.get_attr("IFLA_INFO_KIND") if info else None) or ""


def _stands_on(row: Any, index: int) -> bool:
    """A veth's other end, or an interface of another namespace, is not below it."""
    of_here = row.get_attr("IFLA_LINK_NETNSID") is None and _kind(row) != "veth"
    return of_here and row.get_attr("IFLA_LINK") == index != row["index"]


def find_holder(ifname: str) -> Holder | None:
    """The process with the EtherCAT socket on `ifname`; None if there is none, or no such interface."""
    inodes = master_sockets(ifname)
    for pid, name, sockets in users_of(inodes) if inodes else ():
        return Holder(pid, name, _listening(Path(f"/proc/{pid}"), sockets))
    address = None
    if inodes or is_elsewhere(ifname):
        with contextlib.suppress(ServerError):
            address, its = server_here()
            address = address if its == own_name(ifname) else None
    return Holder(None, "ethercat-server", address) if inodes or address else None


def is_elsewhere(ifname: str) -> bool:
    """Whether this network namespace has no such interface; that of a server's virtual bus may."""
    try:
        look_up(ifname)
    except InterfaceError:
        return True
    return False


def server_here() -> tuple[Address, str]:
    """The server that is used where none is given, and its interface; ServerError if that is none of here."""
    try:
        address = default_server()
        client = Client(address.port, address.host, stream=False)
        with client.connect():
            ifname = client.description.get("interface")
            if not (client.session.same_machine and isinstance(ifname, str)):
                raise ServerError(f"the server at {address} has no interface on this computer")
            return address, ifname
    except UnreachableError:
        raise ServerError(f"no server at {address} ({client.session.problem})") from None
    except (ValueError, ProtocolError) as error:
        raise ServerError(str(error)) from None


def _listening(process: Path, sockets: set[int]) -> Address | None:
    found = []
    for name in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):
            for columns in table(process / "net" / name):
                if int(columns[3], 16) == _LISTEN and int(columns[9]) in sockets:
                    host, _, port = columns[1].partition(":")
                    found.append(Address(_host(host), int(port, 16)))
    # Prefer loopback: only local clients may control the server.
    return min(found, key=lambda row: not ipaddress.ip_address(row.host).is_loopback, default=None)


def _host(text: str) -> str:
    """The host of an address in /proc/net/tcp: 32-bit words in native byte order."""
    raw = bytes.fromhex(text)
    words = struct.unpack(f">{len(raw) // 4}I", raw)
    address = ipaddress.ip_address(struct.pack(f"={len(words)}I", *words))
    if address.is_unspecified:
        return "127.0.0.1" if address.version == 4 else "::1"
    return str(address)
