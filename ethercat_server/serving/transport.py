"""Clients over TCP, the hub's seam to the network: the listening sockets, the accepted ones, and which user
is at the other end of each. `simulation.transport` stands in for it in tests.

Nothing here waits except `Transport.wait`. Errors are those of a non-blocking socket: BlockingIOError for
what cannot be done yet, any other OSError for a connection that is broken. The user is asked of the kernel
(NETLINK_SOCK_DIAG; linux/inet_diag.h, linux/netlink.h, linux/tcp_states.h): one query about one
connection. Only a live socket of exactly this connection counts: the kernel reports an orphaned socket or
one in TIME_WAIT as root's, and for a connection that this machine does not have it answers with the
listener on that port.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import select
import socket
import struct
from collections.abc import Callable, Collection, Sequence
from itertools import islice
from typing import Final, Protocol

from bota_ethercat.address import Address
from ethercat_server.errors import ServerError, UsageError


class Stream(Protocol):
    """One client's connection."""

    peer: str  # the client's address and port

    def recv(self, size: int, /) -> bytes:
        """Up to `size` bytes that have arrived; b"" once the peer has closed its side."""

    def send(self, data: bytes | memoryview, /) -> int:
        """Send as much as can be sent now; returns the number of bytes."""

    def fileno(self) -> int:
        """What `Transport.wait` calls it."""

    def peer_uid(self) -> int | None:
        """The user who owns the other end, None if that cannot be established."""

    def end_sending(self) -> None:
        """Close this side; the peer may still send."""

    def close(self) -> None:
        """Close both sides."""


class Transport(Protocol):
    """Where clients come from."""

    def listening(self) -> Sequence[int]:
        """File descriptors that are readable when a client wants to connect."""

    def accept(self, fd: int) -> Stream | None:
        """The next client that wants to connect to `fd`, None if there is none."""

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        """Which of these can be read and written; waits up to `seconds` until there is at least one."""

    def stop_listening(self) -> None:
        """Refuse new clients."""

    def close(self) -> None:
        """Release everything but the connections."""


_NETLINK_SOCK_DIAG: Final = 4
_SOCK_DIAG_BY_FAMILY: Final = 20
_NLM_F_REQUEST: Final = 1
_NO_COOKIE: Final = b"\xff" * 8
_ALL_STATES: Final = 0xFFFFFFFF

_HEADER: Final = struct.Struct("=IHHII")
_REQUEST: Final = struct.Struct("=BBBBI")
# Ports and addresses of a socket: its own, then the other end's.
_CONNECTION: Final = struct.Struct("!HH16s16s")
_INTERFACE_AND_COOKIE: Final = struct.Struct("=I8s")
# Family, state, timer, retransmissions; connection; interface, cookie; expiry, queues, user, inode.
_ANSWER: Final = struct.Struct("=BBBB36s12sIIIII")

# ESTABLISHED, FIN_WAIT1, FIN_WAIT2, CLOSE_WAIT, LAST_ACK, CLOSING: not LISTEN, not TIME_WAIT.
_LIVE_STATES: Final = frozenset({1, 4, 5, 8, 9, 11})

SocketAddress = tuple[str, int] | tuple[str, int, int, int]


def open_diagnostics() -> socket.socket:
    """The socket that `peer_uid` asks with; OSError if the kernel has no socket diagnostics.

    It has been asked once about each family: the kernel loads a module for the first question, which must not
    happen in the acquisition loop.
    """
    diagnostics = socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, _NETLINK_SOCK_DIAG)
    diagnostics.setblocking(False)  # the kernel answers before send returns
    for family, nobody in ((socket.AF_INET, ("127.0.0.1", 0)), (socket.AF_INET6, ("::1", 0))):
        with contextlib.suppress(OSError):  # no IPv6 on this machine
            diagnostics.send(_question(family, nobody, nobody))
    return diagnostics


def peer_uid(diagnostics: socket.socket, sock: socket.socket) -> int | None:
    """The user who owns the other end of the TCP connection `sock`; None if that cannot be established."""
    try:
        peer, own = sock.getpeername(), sock.getsockname()
        question = _question(sock.family, peer, own)
        with contextlib.suppress(BlockingIOError):  # discard answers to earlier queries
            while True:
                diagnostics.recv(4096)
        diagnostics.send(question)
        answer = diagnostics.recv(4096)
    except OSError:
        return None
    # A client's socket of IPv6 can have this connection too, with addresses such as ::ffff:127.0.0.1.
    mapped = {_mapped(peer, own)} if sock.family == socket.AF_INET else set()
    return _owner(answer, {_connection(peer, own), *mapped})


def _connection(local: SocketAddress, remote: SocketAddress) -> bytes:
    return _CONNECTION.pack(local[1], remote[1], _packed(local[0]), _packed(remote[0]))


def _mapped(local: SocketAddress, remote: SocketAddress) -> bytes:
    return _connection((f"::ffff:{local[0]}", local[1]), (f"::ffff:{remote[0]}", remote[1]))


def _packed(host: str) -> bytes:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.inet_pton(family, host.partition("%")[0]).ljust(16, b"\0")


def _question(family: int, local: SocketAddress, remote: SocketAddress) -> bytes:
    scope = remote[3] if len(remote) == 4 else 0
    body = (
        _REQUEST.pack(family, socket.IPPROTO_TCP, 0, 0, _ALL_STATES)
        + _connection(local, remote)
        + _INTERFACE_AND_COOKIE.pack(scope, _NO_COOKIE)
    )
    return _HEADER.pack(_HEADER.size + len(body), _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 0, 0) + body


def _owner(answer: bytes, connections: Collection[bytes]) -> int | None:
    if len(answer) < _HEADER.size + _ANSWER.size or _HEADER.unpack_from(answer)[1] != _SOCK_DIAG_BY_FAMILY:
        return None  # an error: there is no such socket
    _, state, _, _, its_connection, _, _, _, _, uid, inode = _ANSWER.unpack_from(answer, _HEADER.size)
    if state not in _LIVE_STATES or its_connection not in connections or inode == 0:
        return None
    return int(uid)


_BACKLOG: Final = 128
_LISTEN: Final = "0A"  # in /proc/net/tcp
# Small, so that a client that reads on after a pause gets recent samples, not seconds of old ones.
_SEND_BUFFER: Final = 65536


class SocketStream:
    """An accepted TCP connection."""

    def __init__(self, sock: socket.socket, diagnostics: socket.socket | None) -> None:
        sock.setblocking(False)
        self.peer = "this process"
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.peer = "unknown"
            with contextlib.suppress(OSError):
                self.peer = str(Address(*sock.getpeername()[:2]))
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


def listen(hosts: Sequence[str], port: int) -> list[socket.socket]:
    """A non-blocking listener for each address of `hosts`; ServerError says why it cannot be had.

    A loopback address, or a family, is left out on a machine without it if there is another address.
    Duplicates count once.
    """
    listeners: list[socket.socket] = []
    missing = ""
    for host in _distinct(hosts):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
        except OSError as error:
            problem = f"port {port} on {host} {_reason(error, port)}"
            loopback = error.errno == errno.EADDRNOTAVAIL and ipaddress.ip_address(host).is_loopback
            if loopback or error.errno == errno.EAFNOSUPPORT:
                missing = missing or problem
                continue
            for other in listeners:
                other.close()
            raise ServerError(problem) from None
        listener.setblocking(False)
        listeners.append(listener)
    if missing and not listeners:
        raise ServerError(missing)
    return listeners


def _reason(error: OSError, port: int) -> str:
    """Why an address cannot be used, and what to do."""
    if error.errno == errno.EADDRINUSE:
        who = _listening(port) or " ('ss -ltnp')"
        return f"is in use by another program{who}: stop that one, or choose port {port % 65535 + 1}"
    if error.errno == errno.EADDRNOTAVAIL:
        return "cannot be used: no interface of this machine has this address; 'ip address' lists them"
    return f"cannot be used: {os.strerror(error.errno or 0)}; choose another"


def _listening(port: int) -> str:
    """The process that listens on a port, as part of a sentence; empty if it is not visible."""
    try:
        from ethercat_server.ethercat.nic import table, users_of  # noqa: PLC0415
    except ImportError:  # Windows, where recordings are replayed
        return ""
    inodes: set[int] = set()
    for name in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):
            for row in table(f"/proc/self/net/{name}"):
                if row[3] == _LISTEN and int(row[1].rpartition(":")[2], 16) == port:
                    inodes.add(int(row[9]))
    return "".join(f", process {its.pid} ({its.name})" for its in islice(users_of(inodes), 1))


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
