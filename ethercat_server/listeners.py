"""The sockets that the server listens on."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import ServerError, UsageError

_BACKLOG: Final = 128


def listen(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """A non-blocking listener for each address of `hosts`; ServerError says why there is none.

    ::1 may be missing on this machine if there is another address. One that is given twice counts once.
    """
    listeners: list[socket.socket] = []
    for host in _distinct(hosts):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.socket(family, socket.SOCK_STREAM)
        except OSError:
            continue  # no IPv6 on this machine
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:  # IPv4 has a listener of its own
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        try:
            listener.bind((host, port))
            listener.listen(_BACKLOG)
        except OSError as error:
            listener.close()
            if error.errno == errno.EADDRNOTAVAIL and listeners:
                continue  # no address ::1 on this machine
            for other in listeners:
                other.close()
            raise ServerError(f"port {port} on {host} {_reason(error)}") from None
        listener.setblocking(False)
        listeners.append(listener)
    return listeners


def _reason(error: OSError) -> str:
    """What is wrong with an address, and what to do."""
    if error.errno == errno.EADDRINUSE:
        return "is taken by another program; stop that program or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "cannot be used: this machine has no such address; 'ip address' lists them"
    return f"cannot be used: {error.strerror}; choose another"


def _distinct(hosts: Sequence[str]) -> list[str]:
    """`hosts`, each once; UsageError if one of them has another in it, whose port it would take."""
    addresses = list(dict.fromkeys(ipaddress.ip_address(host) for host in hosts))
    for every in addresses:
        for address in addresses:
            if every.is_unspecified and address != every and address.version == every.version:
                raise UsageError(
                    f"the addresses to listen on overlap: {every} is every address of this machine, "
                    f"{address} too; leave one of the two out"
                )
    return [str(address) for address in addresses]
