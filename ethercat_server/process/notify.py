"""Service notifications to systemd: ready, status, watchdog, stopping. Does nothing without systemd.

The protocol of sd_notify(3): assignments in a datagram to the socket named by NOTIFY_SOCKET.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Final

_NEVER_NS: Final = 1 << 62


class Notifier:
    """The service manager's socket; sending never blocks and never fails."""

    def __init__(self) -> None:
        name = os.environ.pop("NOTIFY_SOCKET", "")
        self._status = ""
        self._socket: socket.socket | None = None
        self.feed_every_ns = _watchdog_ns() // 3
        """Interval between calls of `feed`: a third of the watchdog's timeout."""
        if name:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            with contextlib.suppress(OSError):
                # A name that starts with @ is in the abstract namespace.
                self._socket.connect("\0" + name[1:] if name.startswith("@") else name)

    def ready(self) -> None:
        """The server is streaming."""
        self._send("READY=1")

    def feed(self) -> None:
        """The acquisition loop is running."""
        self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`; sent only if it has changed."""
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
    """Timeout of the watchdog."""
    microseconds, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not microseconds.isdecimal() or process not in {"", str(os.getpid())}:
        return _NEVER_NS
    return int(microseconds) * 1000
