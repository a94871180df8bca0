"""Leaves a network interface out of promiscuous mode if it was out of it."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from typing import Final

from ethercat_server.links.interfaces import open_routes

_IFF_PROMISC: Final = 0x100


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
