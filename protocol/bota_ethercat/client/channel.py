# SPDX-License-Identifier: Apache-2.0
"""The TCP connection under a client, in steps that need not block; the only file here that opens a socket."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Final

from bota_ethercat.address import PORT
from bota_ethercat.errors import ConnectionFailedError, UnreachableError

# Bytes that the kernel may keep, and so the age of what a client that has stalled gets: some 0.5 s.
RECEIVE_BUFFER: Final = 65536
CONNECT_TIMEOUT_S: Final = 2.0
_SEND_TIMEOUT_S: Final = 1.0
_KEEPALIVE: Final = tuple(
    (getattr(socket, option), value)
    for option, value in (("TCP_KEEPIDLE", 2), ("TCP_KEEPALIVE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3))
    if hasattr(socket, option)  # the second is what macOS calls the first
)
# 0 on Windows, where a socket has no timeouts of the kernel's.
_DONT_WAIT: Final = getattr(socket, "MSG_DONTWAIT", 0)


_Found = tuple[socket.AddressFamily, tuple[object, ...]]


class _Lookup(threading.Thread):
    """Looks a host's addresses up, for which name servers can take half a minute; `join`, then read them."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(name="look-up", daemon=True)
        self.found: list[_Found] = []
        self.failed: OSError | ValueError | None = None
        self._where = host, port
        self.start()

    def run(self) -> None:
        try:
            found = socket.getaddrinfo(*self._where, type=socket.SOCK_STREAM)
            self.found = [(family, address) for family, _, _, _, address in found]
        except (OSError, ValueError) as error:  # ValueError: a host name that cannot be one
            self.failed = error


class TcpChannel:
    """A stream of bytes to one server, which can be connected again and again, and the time that it is in.

    Attributes:
        own: the address of this end.
        same_address: whether both ends have one address, and so probably one machine.
        monotonic_ns: CLOCK_MONOTONIC.
    """

    def __init__(self, host: str, port: int, receive_buffer: int = RECEIVE_BUFFER) -> None:
        """Nothing is sent yet. Each attempt looks the host's name up."""
        self._host, self._port, self._receive_buffer = host, port, receive_buffer
        self._lookup: _Lookup | None = None
        self._untried: list[_Found] = []
        self._sock: socket.socket | None = None
        self._give_up_ns = 0
        self._timeout_s = math.nan  # the kernel's; nan: not set, and equal to none
        self.monotonic_ns: Callable[[], int] = time.monotonic_ns
        self.own: tuple[str, int] = ("", 0)
        self.same_address = False

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until `event` is set, `seconds` at most; whether it is."""
        return event.wait(seconds)

    def connect(self, timeout_s: float) -> bool:
        """Begin or go on connecting, waiting at most `timeout_s`; whether it is done. UnreachableError.

        Each address has `CONNECT_TIMEOUT_S`, and so have the name servers. 0 or less does not wait.
        """
        deadline_ns, why = self.monotonic_ns() + round(timeout_s * 1e9), ""
        while True:
            left_s = max(0.0, (deadline_ns - self.monotonic_ns()) * 1e-9)
            try:
                if self._sock is None and not self._look_up(left_s):
                    return self._is_pending()
                if self._sock is None:
                    self._begin(*self._untried.pop(0))
                    continue
                if not _is_writable(self._sock, left_s):
                    return self._is_pending()
                if (failed := self._sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)) != 0:
                    raise OSError(failed, os.strerror(failed))
                self._prepare(self._sock)
                self._untried.clear()
                return True
            except (OSError, ValueError) as error:
                self.close()
                if not why or getattr(error, "errno", 0) != errno.EAFNOSUPPORT:  # this: no IPv6 here
                    why = _reason(error)
                if not self._untried:  # "localhost" is ::1 and 127.0.0.1: the server may listen on one only
                    raise UnreachableError(why) from None

    def _is_pending(self) -> bool:
        """False, as `connect` returns it; OSError after `CONNECT_TIMEOUT_S`."""
        if self.monotonic_ns() < self._give_up_ns:
            return False
        if self._sock is None:
            raise OSError("the name servers do not answer")
        raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))

    def _look_up(self, left_s: float) -> bool:
        """Whether there are addresses to try; waits at most `left_s` for them."""
        if self._untried:
            return True
        if not self._give_up_ns:
            self._give_up_ns = self.monotonic_ns() + round(CONNECT_TIMEOUT_S * 1e9)
        if self._lookup is None:
            try:
                PORT.check(self._port)
            except ValueError as error:
                raise UnreachableError(f"{self._port} is no port: it must be {error}") from None
            self._lookup = _Lookup(self._host, self._port)
        self._lookup.join(left_s)
        if self._lookup.is_alive():
            return False
        self._untried, failed, self._lookup = self._lookup.found, self._lookup.failed, None
        if failed is not None:
            raise failed
        return True

    def _begin(self, family: socket.AddressFamily, address: tuple[object, ...]) -> None:
        self._give_up_ns = self.monotonic_ns() + round(CONNECT_TIMEOUT_S * 1e9)
        self._sock = socket.socket(family, socket.SOCK_STREAM)
        # Before connecting: else the kernel lets it grow to megabytes, which hold a minute of samples.
        self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._receive_buffer)
        self._sock.setblocking(False)
        failed = self._sock.connect_ex(address)
        if failed not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):  # how others went, SO_ERROR tells
            raise OSError(failed, os.strerror(failed))

    def _prepare(self, sock: socket.socket) -> None:
        own, peer = sock.getsockname(), sock.getpeername()
        if own == peer:  # a free ephemeral port can connect to itself
            raise OSError("nothing listens there")
        self.own, self.same_address = own[:2], own[0] == peer[0]
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # for a peer that was switched off
        for option, value in _KEEPALIVE:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
        sock.settimeout(None if _DONT_WAIT else _SEND_TIMEOUT_S)
        self._timeout_s = math.nan
        if _DONT_WAIT:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _timeval(_SEND_TIMEOUT_S))

    def receive(self, buffer: bytearray | memoryview, timeout_s: float) -> int:
        """Receive what fits, waiting at most `timeout_s` for the first byte; 0: nothing came.

        ConnectionFailedError at its end. The kernel's own timeout costs no system call while it is the same.
        """
        sock = self._sock
        try:
            if sock is not None and timeout_s == self._timeout_s:
                count = sock.recv_into(buffer)
            else:
                count = self._receive(sock, buffer, timeout_s)
        except (BlockingIOError, TimeoutError):
            return 0
        except OSError as error:
            raise ConnectionFailedError(error.strerror or str(error)) from None
        if count == 0:
            raise ConnectionFailedError("the server closed it")
        return count

    def _receive(self, sock: socket.socket | None, buffer: bytearray | memoryview, timeout_s: float) -> int:
        if sock is None:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        if not _DONT_WAIT:
            sock.settimeout(max(timeout_s, 0.0))
        elif timeout_s <= 0:
            return sock.recv_into(buffer, 0, _DONT_WAIT)
        else:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(timeout_s))
            self._timeout_s = timeout_s
        return sock.recv_into(buffer)

    def send(self, data: bytes) -> None:
        """Send all of it; ConnectionFailedError."""
        try:
            if self._sock is None:
                raise OSError(errno.EPIPE, os.strerror(errno.EPIPE))
            self._sock.sendall(data)
        except OSError as error:
            raise ConnectionFailedError(f"cannot send: {error.strerror or error}") from None

    def shutdown(self) -> None:
        """End the connection; from any thread, which ends a `receive` in another."""
        if (sock := self._sock) is not None:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Give the connection up, finished or not."""
        self.shutdown()
        self._give_up_ns = 0
        if self._sock is not None:
            self._sock.close()
            self._sock = None

    def fileno(self) -> int:
        """For `poll`: readable when something has arrived; -1 without a connection."""
        return -1 if self._sock is None else self._sock.fileno()


def _is_writable(sock: socket.socket, timeout_s: float) -> bool:
    if not hasattr(select, "poll"):  # on Windows, whose `select` knows no limit of 1,024 descriptors
        return any(select.select((), (sock,), (sock,), timeout_s))
    poll = select.poll()
    poll.register(sock, select.POLLOUT)
    return bool(poll.poll(timeout_s * 1e3))


def _reason(error: OSError | ValueError) -> str:
    """Why there is no connection, without numbers."""
    if isinstance(error, socket.gaierror):  # has numbers of its own
        return error.strerror or str(error)
    return os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)


def _timeval(seconds: float) -> bytes:
    microseconds = max(1, round(seconds * 1e6))  # 0 would be no timeout
    return struct.pack("@ll", *divmod(microseconds, 1_000_000))
