"""Which process uses a network interface as an EtherCAT master, and the TCP port it listens on.

See `packet_sockets`; listening TCP sockets are in /proc/net too. Of another user's process neither is
visible: then the server that programs use by default is asked which interface it uses.
"""

from __future__ import annotations

import contextlib
import ipaddress
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from bota_ethercat.address import Address
from bota_ethercat.client import Client
from bota_ethercat.errors import ProtocolError
from bota_ethercat.program.server_choice import default_server
from ethercat_server.ethercat.nic import master_sockets, table, users_of

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
        if self.pid is not None:
            return f"process {self.pid} ({self.name})"
        return "another EtherCAT master" if self.address is None else self.name


def find_holder(ifname: str) -> Holder | None:
    """The process with the EtherCAT socket on `ifname`; None if there is none, or no such interface."""
    if not (inodes := master_sockets(ifname)):
        return None
    return next(iter(owners(inodes)), None) or Holder(None, "ethercat-server", _default_server(ifname))


def _default_server(ifname: str) -> Address | None:
    """The server that is used where none is given, if it uses this interface."""
    with contextlib.suppress(ValueError, ProtocolError):
        address = default_server()
        with Client(address.port, address.host, stream=False).connect() as client:
            if client.description.get("interface") == ifname:
                return address
    return None


def owners(inodes: set[int], processes: Path = Path("/proc")) -> Iterator[Holder]:
    """The visible processes that have one of these sockets."""
    for process in users_of(inodes, processes):
        yield Holder(process.pid, process.name, _listening(processes / str(process.pid), process.sockets))


def _listening(process: Path, sockets: set[int]) -> Address | None:
    found = []
    for name in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):
            for columns in table(process / "net" / name):
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
