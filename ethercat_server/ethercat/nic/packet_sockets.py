"""The packet sockets on a network interface, and the processes that have them.

Found by inodes: those of the sockets in /proc/net, and those of each process in /proc/PID/fd, where only root
sees other users' descriptors.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

_ETHERCAT: Final = 0x88A4


class Listener(NamedTuple):
    """A packet socket, which receives a copy of frames."""

    protocol: int  # Ethernet type; 3 for all
    ifindex: int  # interface; 0 for all
    inode: int


class Process(NamedTuple):
    """A process that has sockets."""

    pid: int
    name: str
    sockets: set[int]  # inodes of all its sockets


def master_sockets(ifname: str) -> set[int]:
    """Inodes of the EtherCAT sockets on `ifname`; empty if there is none, or no such interface."""
    try:
        index = socket.if_nametoindex(ifname)
    except OSError:
        return set()
    return {row.inode for row in packet_sockets() if (row.protocol, row.ifindex) == (_ETHERCAT, index)}


def packet_sockets(path: str | Path = "/proc/self/net/packet") -> list[Listener]:
    """The packet sockets of this network namespace, from the kernel's table of them."""
    return [Listener(int(row[3], 16), int(row[4]), int(row[-1])) for row in table(path)]


def users_of(inodes: set[int], processes: Path = Path("/proc")) -> Iterator[Process]:
    """The visible processes that have one of these sockets."""
    for process in processes.iterdir():
        if process.name.isdecimal() and (sockets := set(_sockets(process))) & inodes:
            name = ""
            with contextlib.suppress(OSError):  # it has just ended
                name = (process / "comm").read_text(encoding="utf-8", errors="replace").strip()
            yield Process(int(process.name), name, sockets)


def table(path: str | Path) -> Iterator[list[str]]:
    """The rows of a table in /proc/net."""
    for line in Path(path).read_text(encoding="ascii").splitlines()[1:]:
        yield line.split()


def _sockets(process: Path) -> Iterator[int]:
    with contextlib.suppress(OSError):  # it has ended, or is another user's
        for descriptor in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                target = str(descriptor.readlink())
                if target.startswith("socket:["):
                    yield int(target[8:-1])
