"""Which user owns the other end of a TCP connection, asked of the kernel (NETLINK_SOCK_DIAG).

One query about one connection, answered at once however many sockets there are. Only a live socket of exactly
this connection counts: the kernel reports an orphaned socket or one in TIME_WAIT as root's, and for a
connection that this machine does not have it answers with the listener on that port.
(linux/inet_diag.h, linux/netlink.h, linux/tcp_states.h)
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Collection
from typing import Final

_NETLINK_SOCK_DIAG: Final = 4
_SOCK_DIAG_BY_FAMILY: Final = 20
_NLM_F_REQUEST: Final = 1
_NO_COOKIE: Final = b"\xff" * 8
_ALL_STATES: Final = 0xFFFFFFFF

_HEADER: Final = struct.Struct("=IHHII")
_REQUEST: Final = struct.Struct("=BBBBI")
_CONNECTION: Final = struct.Struct("!HH16s16s")
"""Ports and addresses of a socket: its own, then the other end's."""
_INTERFACE_AND_COOKIE: Final = struct.Struct("=I8s")
_ANSWER: Final = struct.Struct("=BBBB36s12sIIIII")
"""Family, state, timer, retransmissions; connection; interface, cookie; expiry, queues, user, inode."""

_LIVE_STATES: Final = frozenset({1, 4, 5, 8, 9, 11})
"""ESTABLISHED, FIN_WAIT1, FIN_WAIT2, CLOSE_WAIT, LAST_ACK, CLOSING: not LISTEN, not TIME_WAIT."""

Address = tuple[str, int] | tuple[str, int, int, int]


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


def _connection(local: Address, remote: Address) -> bytes:
    return _CONNECTION.pack(local[1], remote[1], _packed(local[0]), _packed(remote[0]))


def _mapped(local: Address, remote: Address) -> bytes:
    return _connection((f"::ffff:{local[0]}", local[1]), (f"::ffff:{remote[0]}", remote[1]))


def _packed(host: str) -> bytes:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.inet_pton(family, host.partition("%")[0]).ljust(16, b"\0")


def _question(family: int, local: Address, remote: Address) -> bytes:
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
