"""Stands for systemd: the notify socket, and what came through it."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.server.running import wait_until

WATCHDOG_US = 600_000


class Manager:
    """A service manager, its socket in `directory`."""

    def __init__(self, directory: Path) -> None:
        self._path = str(directory / "notify")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self._path)
        self._socket.setblocking(False)
        self._told: list[str] = []

    @contextlib.contextmanager
    def environment(self) -> Iterator[None]:
        """What is started within is its service."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("NOTIFY_SOCKET", self._path)
            patch.setenv("WATCHDOG_USEC", str(WATCHDOG_US))
            patch.delenv("WATCHDOG_PID", raising=False)
            yield

    @property
    def told(self) -> list[str]:
        """What it has been told so far. Until it looks the kernel keeps ten messages, and no more."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self._told.append(self._socket.recv(4096).decode())
        return self._told

    def wait(self, text: str) -> None:
        """Until it is told this."""
        wait_until(lambda: any(text in told for told in self.told), f"{text} in {self._told}")

    def close(self) -> None:
        self._socket.close()
