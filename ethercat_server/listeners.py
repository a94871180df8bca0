"""The sockets that the server listens on."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import Final

from ethercat_server.errors import ServerError

_BACKLOG: Final = 128


def listen(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """A non-blocking listener for each address of `hosts`; ServerError says why there is none.

    ::1 may be missing on this machine if there is another address.
    """
    listeners: list[socket.socket] = []
    for host in hosts:
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
            reason = (
                "is taken by another program"
                if error.errno == errno.EADDRINUSE
                else f"cannot be used: {error.strerror}"
            )
            raise ServerError(
                f"port {port} on {host} {reason}; stop that program or choose another port"
            ) from None
        listener.setblocking(False)
        listeners.append(listener)
    return listeners
