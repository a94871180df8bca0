"""The network interfaces of this machine, as the kernel describes them; and which process uses one as an
EtherCAT master, with the TCP port it listens on.

See `packet_sockets`; listening TCP sockets are in /proc/net too. Of another user's process, and in another
network namespace, neither is visible: then the server that programs use by default is asked for
its interface.
"""

from __future__ import annotations

import contextlib
import ipaddress
import struct
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.errors import ProtocolError, UnreachableError
from bota_ethercat.program.server_choice import default_server
from ethercat_server.errors import InterfaceError, ServerError
from ethercat_server.ethercat.nic import (
    Interface,
    Routes,
    find_routes,
    interfaces,
    look_up,
    master_sockets,
    own_name,
    table,
    users_of,
)

# Kinds that a sensor can be connected to: network cards, and what tests use for one.
_CARDS: Final = frozenset({"", "veth"})
_LISTEN: Final = 0x0A
_NO_ROUTES: Final = Routes()
# The counters of an interface, in the kernel's order (linux/if_link.h).
_COUNTERS: Final = (
    "rx_packets", "tx_packets", "rx_bytes", "tx_bytes", "rx_errors", "tx_errors", "rx_dropped", "tx_dropped",
    "multicast", "collisions", "rx_length_errors", "rx_over_errors", "rx_crc_errors", "rx_frame_errors",
    "rx_fifo_errors", "rx_missed_errors", "tx_aborted_errors", "tx_carrier_errors", "tx_fifo_errors",
)  # fmt: skip


class Holder(NamedTuple):
    """A process that uses an interface."""

    pid: int | None  # None if it is not visible to this user
    name: str
    address: Address | None  # the TCP address it listens on; None if it does not, or if that is not visible

    def __str__(self) -> str:
        if self.pid is not None:
            return f"process {self.pid} ({self.name})"
        return "another EtherCAT master" if self.address is None else self.name


@dataclass(frozen=True)
class Adapter(Interface):
    """A network interface, with what there is to it on this machine."""

    master: str = ""  # bridge or bond that it is a part of
    upper: tuple[str, ...] = ()  # interfaces that stand on it, such as VLANs
    routes: Routes = _NO_ROUTES
    holder: Holder | None = None  # the EtherCAT master that uses it

    @property
    def state(self) -> str:
        return "down" if not self.up else "up" if self.carrier else "up, no carrier"

    @property
    def counters(self) -> Mapping[str, int]:
        return dict(zip(_COUNTERS, array("Q", self.stats[: 8 * len(_COUNTERS)]), strict=False))

    @property
    def unfit(self) -> str | None:
        """Why nobody should look for a sensor on it; None if it is a candidate."""
        if self.loopback:
            return "loopback"
        wireless = is_wireless(Path("/sys/class/net") / self.name)
        if not self.ethernet or wireless or self.kind not in _CARDS:
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
            found.append(replace(row, routes=find_routes(row.ifindex), holder=find_holder(row.name)))
    return found


def links() -> list[Adapter]:
    """All interfaces of this machine, without their routes and users."""
    rows = interfaces()
    names = {row.ifindex: row.name for row in rows}
    return [
        Adapter(
            **vars(row),
            master=names.get(row.master_index, ""),
            # A veth's other end, or an interface of another namespace, does not stand on it.
            upper=tuple(
                each.name for each in rows
                if each.link == row.ifindex != each.ifindex and not each.namespace and each.kind != "veth"
            ),
        )
        for row in rows
    ]  # fmt: skip


def is_wireless(folder: Path) -> bool:
    """By its folder in /sys/class/net."""
    return any((folder / mark).exists() for mark in ("wireless", "phy80211"))


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
