"""What the kernel says of a network interface, over netlink and ethtool. Needs no rights.

Asked of the kernel, not of /sys: /sys shows the network namespace that it was mounted in.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from ethercat_server.doctor import ethtool
from ethercat_server.doctor.finding import cannot_look

_GET_FLAGS: Final = 0x8913
_SET_FLAGS: Final = 0x8914
_IFF_PROMISC: Final = 0x100
_MAIN_TABLE: Final = 254
_MADE_BY_KERNEL: Final = 2
_NO_SUPPORT: Final = "the driver does not support it"
_IFF_UP, _IFF_LOOPBACK = 0x1, 0x8
_LINK_LOCAL_SCOPE: Final = 253


@dataclass(frozen=True)
class Link:
    """The interface itself."""

    index: int
    kind: str = ""
    """Of a virtual one, such as veth or bridge; empty for a network card."""
    up: bool = True
    carrier: bool = True
    loopback: bool = False
    master: str = ""
    """Bridge or bond that it is a part of."""
    upper: tuple[str, ...] = ()
    """Interfaces that stand on it, such as VLANs."""
    parent: str = ""
    """Device behind it, by the kernel's name, such as 0000:00:1f.6 or virtio2."""
    counters: dict[str, int] = field(default_factory=dict)
    carrier_changes: int | None = None


@dataclass(frozen=True)
class Routes:
    """Addresses and routes on it."""

    addresses: tuple[str, ...] = ()
    """With the length of their prefix; link-local ones of IPv6 are not among them."""
    link_local: tuple[str, ...] = ()
    default: bool = False
    """The machine's default route goes here."""
    others: tuple[str, ...] = ()
    """Destinations of the routes that somebody made."""


@dataclass(frozen=True)
class InterfaceFacts:
    """What is known; each part is a sentence instead where it could not be asked for."""

    link: Link | str | None = None
    """None: there is no such interface."""
    names: tuple[str, ...] = ()
    """The interfaces that there are."""
    routes: Routes | str = "not asked"
    settings: tuple[int | None, str | None] | str = "not asked"
    """Speed in Mbit/s and duplex."""
    driver: tuple[str, str] | str = "not asked"
    """Its name, and the bus the card is on."""
    coalescing: dict[str, int] | str = "not asked"
    offloads: dict[str, bool] | str = "not asked"
    eee: tuple[bool, bool] | str = "not asked"
    """Whether it is switched on, and in use."""

    @property
    def there(self) -> Link:
        """The interface; CannotLookError if there is none."""
        if self.link is None:
            cannot_look("there is no such interface")
        there: Link = known(self.link)
        return there


def known(part: Any) -> Any:
    """A part of the facts; CannotLookError with its sentence if it is not known."""
    return cannot_look(part) if isinstance(part, str) else part


def collect(ifname: str) -> InterfaceFacts:
    """Ask for everything about `ifname`; never an exception."""
    names = tuple(name for _, name in socket.if_nameindex())
    if ifname not in names:
        return InterfaceFacts(names=names)
    return InterfaceFacts(
        link=_asked(_link, ifname),
        names=names,
        routes=_asked(_routes, ifname),
        settings=_asked(ethtool.settings, ifname),
        driver=_asked(ethtool.driver, ifname),
        coalescing=_asked(ethtool.coalescing, ifname),
        offloads=_asked(ethtool.offloads, ifname),
        eee=_asked(ethtool.eee, ifname),
    )


def _asked(ask: Callable[[str], Any], ifname: str) -> Any:
    try:
        return ask(ifname)
    except OSError as error:
        return _NO_SUPPORT if error.errno == errno.EOPNOTSUPP else error.strerror or str(error)
    except Exception as error:  # noqa: BLE001 - pyroute2's errors share no base, and no part spoils the others
        name = type(error).__name__
        return _NO_SUPPORT if name == "NotSupportedError" else f"{name}: {error}".replace("\0", "").strip()


def _link(ifname: str) -> Link:
    from pyroute2 import IPRoute  # noqa: PLC0415 - takes a moment

    with IPRoute() as route:
        everyone = {row["index"]: row for row in route.get_links()}
    index = socket.if_nametoindex(ifname)
    own = everyone[index]
    info = own.get_attr("IFLA_LINKINFO")
    upper = [r for r in everyone.values() if r.get_attr("IFLA_LINK") == index and _is_local(r)]
    master = everyone.get(own.get_attr("IFLA_MASTER"))
    up = bool(own["flags"] & _IFF_UP)
    return Link(
        index=index,
        kind=(info.get_attr("IFLA_INFO_KIND") if info else None) or "",
        up=up,
        carrier=up and own.get_attr("IFLA_CARRIER") == 1,
        loopback=bool(own["flags"] & _IFF_LOOPBACK),
        master=master.get_attr("IFLA_IFNAME") if master else "",
        upper=tuple(row.get_attr("IFLA_IFNAME") for row in upper if row["index"] != index),
        parent=own.get_attr("IFLA_PARENT_DEV_NAME") or "",
        counters=counters_of(own),
        carrier_changes=own.get_attr("IFLA_CARRIER_CHANGES"),
    )


def _is_local(row: Any) -> bool:
    """Whether it may stand on an interface of this namespace: a veth's other end does not."""
    info = row.get_attr("IFLA_LINKINFO")
    kind = info.get_attr("IFLA_INFO_KIND") if info else None
    return row.get_attr("IFLA_LINK_NETNSID") is None and kind != "veth"


def counters_of(row: Any) -> dict[str, int]:
    """The counters in an interface's row, by the kernel's names."""
    found = row.get_attr("IFLA_STATS64") or row.get_attr("IFLA_STATS") or {}
    return {name: int(found[name]) for name in found.keys() if isinstance(found[name], int)}  # noqa: SIM118


def read_counters(ifname: str) -> dict[str, int]:
    """The counters of `ifname` as they are now; empty if they cannot be read."""
    link = _asked(_link, ifname)
    return dict(link.counters) if isinstance(link, Link) else {}


@contextlib.contextmanager
def promiscuity_kept(ifname: str) -> Iterator[None]:
    """Within it the bus may be opened; afterwards the interface is promiscuous only if it was before.

    SOEM makes it so and leaves it so.
    """
    before = _flags(ifname)
    try:
        yield
    finally:
        now = _flags(ifname)
        if before is not None and now is not None and now & ~before & _IFF_PROMISC:
            with contextlib.suppress(OSError):
                _flags(ifname, now & ~_IFF_PROMISC)


def _flags(ifname: str, wanted: int | None = None) -> int | None:
    """The interface's flags, which become `wanted`; None if it has gone."""
    request = struct.pack("16sH14x", os.fsencode(ifname), wanted or 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        try:
            answer = fcntl.ioctl(asked, _GET_FLAGS if wanted is None else _SET_FLAGS, request)
        except OSError:
            return None
    flags: int = struct.unpack("16xH14x", answer)[0]
    return flags


def _routes(ifname: str) -> Routes:
    from pyroute2 import IPRoute  # noqa: PLC0415 - takes a moment

    index = socket.if_nametoindex(ifname)
    with IPRoute() as route:
        addresses = [row for row in route.get_addr(index=index) if row["index"] == index]
        routes = [
            row
            for family in (socket.AF_INET, socket.AF_INET6)
            for row in route.get_routes(oif=index, family=family)
            if row.get_attr("RTA_OIF") == index and row.get_attr("RTA_TABLE") == _MAIN_TABLE
        ]
    texts = [
        (f"{row.get_attr('IFA_LOCAL') or row.get_attr('IFA_ADDRESS')}/{row['prefixlen']}", row)
        for row in addresses
    ]
    local = {
        text for text, row in texts if row["family"] == socket.AF_INET6 and row["scope"] == _LINK_LOCAL_SCOPE
    }
    made = [row for row in routes if row["proto"] != _MADE_BY_KERNEL and row["dst_len"]]
    return Routes(
        addresses=tuple(text for text, _ in texts if text not in local),
        link_local=tuple(sorted(local)),
        default=any(row["dst_len"] == 0 for row in routes),
        others=tuple(f"{row.get_attr('RTA_DST')}/{row['dst_len']}" for row in made),
    )
