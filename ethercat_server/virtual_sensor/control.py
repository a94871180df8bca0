"""The Unix socket by which a virtual sensor takes commands: where it is, and how one is sent."""

from __future__ import annotations

import errno
import os
import socket
import tempfile
from pathlib import Path
from typing import Final

_ANSWER_S: Final = 5.0
_LONGEST_ANSWER: Final = 1 << 20


def own_socket() -> str:
    """Where this user's virtual sensor takes commands if no other place is given."""
    folder = f"/run/user/{os.geteuid()}"
    if not os.access(folder, os.W_OK):  # none, or hidden from a service by ProtectHome=
        folder = tempfile.gettempdir()
    return f"{folder}/ethercat-virtual-sensor-{os.geteuid()}"


def send(path: str, command: str) -> str:
    """The answer to a command of a virtual sensor that listens there, this user's or root's; OSError."""
    if Path(path).stat().st_uid not in (0, os.geteuid()):
        raise PermissionError(errno.EPERM, "it is another user's")
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock,
    ):
        sock.bind(f"{folder}/answer")
        sock.settimeout(_ANSWER_S)
        sock.connect(path)
        sock.send(command.encode())
        return sock.recv(_LONGEST_ANSWER).decode()
