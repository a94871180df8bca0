"""Clients over TCP: the listening sockets, the accepted ones, and which user is at the other end of each."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import select
import socket
from collections.abc import Callable, Collection, Sequence
from typing import Final

from bota_ethercat.address import Address
from ethercat_server.errors import ServerError, UsageError
from ethercat_server.serving.transport.peer_uid import open_diagnostics, peer_uid

_BACKLOG: Final = 128
_SEND_BUFFER: Final = 65536
"""Small, so that a client that reads on after a pause gets recent samples, not seconds of old ones."""


_EXCLUSIVE: Final = getattr(socket, "SO_EXCLUSIVEADDRUSE", socket.SO_REUSEADDR)
"""On Windows the second would share a port with another program; here it takes one in TIME_WAIT."""


class SocketStream:
    """An accepted TCP connection."""

    def __init__(self, sock: socket.socket, diagnostics: socket.socket | None) -> None:
        sock.setblocking(False)
        self.peer = "this process"
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.peer = _peer(sock)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._sock = sock
        self._diagnostics = diagnostics
        # The socket's own methods: a sample is sent without a call in between.
        self.recv: Callable[[int], bytes] = sock.recv
        self.send: Callable[[bytes | memoryview], int] = sock.send
        self.fileno = sock.fileno
        self.close = sock.close

    def peer_uid(self) -> int | None:
        """See `Stream`."""
        return None if self._diagnostics is None else peer_uid(self._diagnostics, self._sock)

    def end_sending(self) -> None:
        """See `Stream`."""
        with contextlib.suppress(OSError):
            self._sock.shutdown(socket.SHUT_WR)


class SocketTransport:
    """The listening sockets of one port."""

    def __init__(self, hosts: Sequence[str], port: int) -> None:
        """Bind at once, so that a port in use is found before the bus is touched; ServerError then."""
        self.port = port
        self._listeners = {listener.fileno(): listener for listener in listen(hosts, port)}
        self._diagnostics = open_diagnostics() if hasattr(socket, "AF_NETLINK") else None

    def listening(self) -> Sequence[int]:
        """See `Transport`."""
        return tuple(self._listeners)

    def accept(self, fd: int) -> SocketStream | None:
        """See `Transport`."""
        try:
            sock, _ = self._listeners[fd].accept()
            return SocketStream(sock, self._diagnostics)
        except OSError:
            return None  # it has gone already

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        """See `Transport`."""
        readable, writable, _ = select.select(readers, writers, (), seconds)
        return readable, writable

    def stop_listening(self) -> None:
        """See `Transport`."""
        for listener in self._listeners.values():
            listener.close()
        self._listeners = {}

    def close(self) -> None:
        """See `Transport`."""
        self.stop_listening()
        if self._diagnostics is not None:
            self._diagnostics.close()


def _peer(sock: socket.socket) -> str:
    try:
        return str(Address(*sock.getpeername()[:2]))
    except OSError:
        return "unknown"


def listen(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """A non-blocking listener for each address of `hosts`; ServerError says why it cannot be had.

    ::1 is left out on a machine without it if there is another address. Duplicates count once.
    """
    listeners: list[socket.socket] = []
    for host in _distinct(hosts):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.socket(family, socket.SOCK_STREAM)
        except OSError:
            continue  # no IPv6 on this machine
        listener.setsockopt(socket.SOL_SOCKET, _EXCLUSIVE, 1)
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
    """Why an address cannot be used, and what to do."""
    if error.errno == errno.EADDRINUSE:
        return "is in use by another program; stop that program or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return "cannot be used: no interface of this machine has this address; 'ip address' lists them"
    return f"cannot be used: {error.strerror}; choose another"


def _distinct(hosts: Sequence[str]) -> list[str]:
    """`hosts` without duplicates; UsageError if one is a wildcard that includes another."""
    addresses = list(dict.fromkeys(ipaddress.ip_address(host) for host in hosts))
    for every in addresses:
        for address in addresses:
            if every.is_unspecified and address != every and address.version == every.version:
                raise UsageError(
                    f"the addresses to listen on overlap: {every} includes {address}; remove one of the two"
                )
    return [str(address) for address in addresses]
