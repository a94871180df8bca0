"""Which process uses a network interface as an EtherCAT master, and the TCP port it listens on.

Found by socket inodes: those of packet sockets and of listening TCP sockets in /proc/net, and those of each
process in /proc/PID/fd, where only root sees other users' descriptors.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from protocol.address import Address

_ETHERCAT: Final = 0x88A4
_LISTEN: Final = 0x0A


class Holder(NamedTuple):
    """A process that uses an interface."""

    pid: int | None
    """None if it is not visible to this user."""
    name: str
    address: Address | None
    """TCP address it listens on; None if it does not, or if that is not visible."""

    def __str__(self) -> str:
        """Its description in messages."""
        return "another EtherCAT master" if self.pid is None else f"process {self.pid} ({self.name})"


class Listener(NamedTuple):
    """A packet socket, which receives a copy of frames."""

    protocol: int
    """Ethernet type; 3 for all."""
    ifindex: int
    """Interface; 0 for all."""
    inode: int


def find_holder(ifname: str) -> Holder | None:
    """The process with the EtherCAT socket on `ifname`; None if there is none, or no such interface."""
    try:
        index = socket.if_nametoindex(ifname)
    except OSError:
        return None
    inodes = {row.inode for row in packet_sockets() if (row.protocol, row.ifindex) == (_ETHERCAT, index)}
    return next(iter(owners(inodes)), Holder(None, "", None)) if inodes else None


def packet_sockets(table: str | Path = "/proc/self/net/packet") -> list[Listener]:
    """The packet sockets of this network namespace, from the kernel's `table` of them."""
    return [Listener(int(row[3], 16), int(row[4]), int(row[-1])) for row in _table(table)]


def owners(inodes: set[int], processes: Path = Path("/proc")) -> Iterator[Holder]:
    """The visible processes that have one of these sockets."""
    for process in processes.iterdir():
        if process.name.isdecimal() and (sockets := set(_sockets(process))) & inodes:
            name = ""
            with contextlib.suppress(OSError):  # it has just ended
                name = (process / "comm").read_text().strip()
            yield Holder(int(process.name), name, _listening(process, sockets))


def _table(path: str | Path) -> Iterator[list[str]]:
    for line in Path(path).read_text(encoding="ascii").splitlines()[1:]:
        yield line.split()


def _sockets(process: Path) -> Iterator[int]:
    with contextlib.suppress(OSError):  # it has ended, or is another user's
        for descriptor in (process / "fd").iterdir():
            with contextlib.suppress(OSError):
                target = str(descriptor.readlink())
                if target.startswith("socket:["):
                    yield int(target[8:-1])


def _listening(process: Path, sockets: set[int]) -> Address | None:
    found = []
    for table in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):
            for columns in _table(process / "net" / table):
                if int(columns[3], 16) == _LISTEN and int(columns[9]) in sockets:
                    host, _, port = columns[1].partition(":")
                    found.append(Address(_host(host), int(port, 16)))
    # Prefer loopback: only local clients may control the server.
    return min(found, key=lambda row: not ipaddress.ip_address(row.host).is_loopback, default=None)


def _host(text: str) -> str:
    """The host of an address in /proc/net/tcp: 32-bit words in native byte order."""
    raw = bytes.fromhex(text)
    words = struct.unpack(f">{len(raw) // 4}I", raw)
    packed = struct.pack(f"={len(words)}I", *words)
    address = ipaddress.ip_address(packed)
    if address.is_unspecified:
        return "127.0.0.1" if address.version == 4 else "::1"
    return str(address)
