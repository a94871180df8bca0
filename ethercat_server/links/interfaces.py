"""The kernel's table of network interfaces, by pyroute2, and what its rows say."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from ethercat_server.links.link import signals_held_back


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
