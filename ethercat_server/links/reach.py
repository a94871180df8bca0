"""Opens the link for an interface or a server given on the command line."""

from __future__ import annotations

from ethercat_server.errors import InterfaceError, UsageError
from ethercat_server.links.direct import DirectLink
from ethercat_server.links.holder import find_holder
from ethercat_server.links.link import Link, note
from ethercat_server.links.remote import ServerLink
from protocol.address import Address
from protocol.program.server_choice import default_server, is_address


def open_link(
    ifname: str | None,
    server: str | None,
    *,
    slave: str | None = None,
    force: bool = False,
    allow_ip: bool = False,
) -> Link:
    """The link to the sensors on `ifname`, or behind `server`; UsageError if both are given.

    If a server uses the interface, the link goes through that server, with a note. With `slave`, to that
    foreign slave instead, to be read only; with `force`, a bus in use is taken over, with `allow_ip`, an
    interface of the machine's network is used.
    """
    link = find_server(ifname, server)
    if link is not None:
        if slave is not None:
            link.close()
            raise UsageError("a server reads the objects of sensors only: stop it to read those of a slave")
        return link
    assert ifname is not None
    return DirectLink(ifname, slave=slave, force=force, allow_ip=allow_ip)


def find_server(ifname: str | None, server: str | None) -> ServerLink | None:
    """The named server, or the one that uses the interface; None if the interface is not in use.

    With neither, the default server; an `ifname` such as localhost:12001 is a server too.
    """
    if ifname is not None and server is not None:
        raise UsageError("name either an interface, such as ens5, or a server with --server HOST:PORT")
    if ifname is None or (":" in ifname and is_address(ifname)):
        text = server or ifname
        try:
            return ServerLink(default_server() if text is None else Address.parse(text))
        except ValueError as error:
            raise UsageError(f"--server {error}" if server else str(error)) from None
    holder = find_holder(ifname)
    if holder is None:
        return None
    if holder.address is None:
        if holder.pid is None:
            hint = "run as root, or name its server with --server HOST:PORT"
        else:
            hint = "it serves no TCP port, so stop it first"
        raise InterfaceError(f"{ifname} is in use by {holder}: {hint}")
    used = f"the server at {holder.address}, {holder}, which uses {ifname}"
    note(f"going through {used}")
    return ServerLink(holder.address, used)
