"""Opens the link that the command line asks for, or that the machine's state calls for."""

from __future__ import annotations

import sys

from ethercat_server.errors import InterfaceError, UsageError
from ethercat_server.tool.direct import DirectLink
from ethercat_server.tool.holder import find_holder
from ethercat_server.tool.link import Link
from ethercat_server.tool.remote import ServerLink
from protocol.address import Address


def open_link(ifname: str | None, server: str | None, *, any_slave: bool = False) -> Link:
    """The link to the sensors on `ifname`, or behind `server`; UsageError unless exactly one is given.

    If a server holds the interface it goes through that, and says so. With `any_slave`, slaves on the
    interface that are no sensors are there too: for what only looks.
    """
    link = find_server(ifname, server)
    if link is not None:
        return link
    assert ifname is not None
    return DirectLink(ifname, any_slave=any_slave)


def find_server(ifname: str | None, server: str | None) -> ServerLink | None:
    """The server that is named, or that holds the interface; None if nobody holds it."""
    if (ifname is None) == (server is None):
        raise UsageError("name either an interface, such as ens5, or a server with --server HOST:PORT")
    if server is not None:
        try:
            address = Address.parse(server)
        except ValueError as error:
            raise UsageError(f"--server {error}") from None
        return ServerLink(address)
    assert ifname is not None
    holder = find_holder(ifname)
    if holder is None:
        return None
    if holder.address is None:
        if holder.pid is None:
            hint = "run as root, or name its server with --server HOST:PORT"
        else:
            hint = "it serves no port that the tool could use, so stop it first"
        raise InterfaceError(f"{ifname} is in use by {holder}: {hint}")
    used = f"the server at {holder.address}, {holder}, which holds {ifname}"
    sys.stderr.write(f"ethercat-sensor: going through {used}\n")
    return ServerLink(holder.address, used)
