"""The service manager's side of the server: readiness, status line, watchdog."""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Final

from ethercat_server.server import Server

_NEVER_NS: Final = 1 << 62


class Notifier:
    """The service manager's socket (sd_notify(3)); sending never blocks and never fails.

    Without systemd it does nothing.
    """

    def __init__(self) -> None:
        name = os.environ.pop("NOTIFY_SOCKET", "")
        self._status = ""
        self._socket: socket.socket | None = None
        self.feed_every_ns = _watchdog_ns() // 3  # a third of the watchdog's timeout
        if name:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            with contextlib.suppress(OSError):
                # A name that starts with @ is in the abstract namespace.
                self._socket.connect("\0" + name[1:] if name.startswith("@") else name)

    def feed(self) -> None:
        self.send("WATCHDOG=1")

    def update(self, server: Server) -> None:
        """One line for `systemctl status`; sent only if it has changed."""
        sensors = server.sensors
        lost = [sensor.number for sensor in sensors if not sensor.streams]
        text = f"streaming {len(sensors) - len(lost)} of {len(sensors)} sensors"
        if lost:
            text += f", lost: {', '.join(map(str, lost))}"
        text += f"; {len(server.hub.connections)} clients"
        if text != self._status:
            self._status = text
            self.send(f"STATUS={text}")

    def send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(text.encode())


def _watchdog_ns() -> int:
    """Timeout of the watchdog."""
    microseconds, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not microseconds.isdecimal() or process not in {"", str(os.getpid())}:
        return _NEVER_NS
    return int(microseconds) * 1000
