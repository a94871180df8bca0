"""Who may change something: asked of the kernel, never of the client.

The kernel's TCP tables name the user that owns the other end of a loopback connection. Anything that cannot
be established is refused.
"""

from __future__ import annotations

import os
import socket
import struct
from pathlib import Path
from typing import Final

_TABLES: Final = {socket.AF_INET: Path("/proc/net/tcp"), socket.AF_INET6: Path("/proc/net/tcp6")}


def peer_uid(sock: socket.socket) -> int | None:
    """The user who owns the other end of `sock`, or None if it is not on this machine or already gone."""
    table = _TABLES.get(socket.AddressFamily(sock.family))
    if table is None:
        return None
    try:
        # Seen from the other end: its local address is our peer.
        wanted = f"{_table_address(sock.getpeername())} {_table_address(sock.getsockname())}"
        lines = table.read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        columns = line.split()
        if f"{columns[1]} {columns[2]}" == wanted:
            return int(columns[7])
    return None


def may_control(sock: socket.socket) -> bool:
    """Whether the other end belongs to root, to the server's own user or to the user who ran sudo."""
    uid = peer_uid(sock)
    if uid is None:
        return False
    allowed = {0, os.geteuid()}
    sudo_uid = os.environ.get("SUDO_UID", "")
    if sudo_uid.isdecimal():
        allowed.add(int(sudo_uid))
    return uid in allowed


def _table_address(address: tuple[str, int] | tuple[str, int, int, int]) -> str:
    """An address as the kernel's table has it: 32-bit words in the machine's byte order, port in hex."""
    host, port = address[:2]
    packed = socket.inet_pton(socket.AF_INET6 if ":" in host else socket.AF_INET, host)
    words = struct.unpack(f"={len(packed) // 4}I", packed)
    return "".join(f"{word:08X}" for word in words) + f":{port:04X}"
