"""Tells systemd how the server is doing: ready, status, watchdog, stopping. Nothing without systemd.

The protocol is sd_notify(3)'s: assignments in a datagram to the socket that NOTIFY_SOCKET names.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Final

_NEVER_NS: Final = 1 << 62


class Notifier:
    """The service manager's socket; sending never waits and never fails."""

    def __init__(self) -> None:
        name = os.environ.pop("NOTIFY_SOCKET", "")
        self._status = ""
        self._socket: socket.socket | None = None
        self.feed_every_ns = _watchdog_ns() // 3
        """How often `feed` is to be called: the watchdog forgives two that come late."""
        if name:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            with contextlib.suppress(OSError):
                # A name that starts with @ is in the abstract namespace.
                self._socket.connect("\0" + name[1:] if name.startswith("@") else name)

    def ready(self) -> None:
        """The server streams."""
        self._send("READY=1")

    def feed(self) -> None:
        """The acquisition loop is going round."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`; sent if it is another than before."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def stopping(self) -> None:
        """The server is shutting down."""
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(text.encode())


def _watchdog_ns() -> int:
    """The time in which the watchdog must be fed."""
    microseconds, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not microseconds.isdecimal() or process not in {"", str(os.getpid())}:
        return _NEVER_NS
    return int(microseconds) * 1000
