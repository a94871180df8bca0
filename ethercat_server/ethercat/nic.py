"""Checks a network interface before the bus is opened on it, and keeps other masters of ours away from it.

SOEM itself would say only that it failed, and open it beside another master.
"""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from ethercat_server.errors import InterfaceError

MAX_NAME_LENGTH: Final = 15
"""Linux's limit; a longer name would overflow SOEM's buffer."""

_SIOCGIFFLAGS: Final = 0x8913
_ETHERCAT: Final = 0x88A4
_IFF_UP: Final = 0x1
_IFF_LOOPBACK: Final = 0x8
_IFF_RUNNING: Final = 0x40
_CARRIER_TIMEOUT_S: Final = 5.0
_LOCK: Final = "\0bota-ethercat-bridge/ifindex/{}"
"""An abstract Unix socket: it belongs to the network namespace, and goes with the process that has it."""
_CAPABILITIES: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}


@contextlib.contextmanager
def claimed(ifname: str) -> Iterator[None]:
    """Within it the bus may be opened on `ifname`, by nobody else of this project.

    InterfaceError unless the interface exists, is free, is up, has a carrier and may be opened.
    """
    _check_allowed(ifname)
    index = {name: number for number, name in socket.if_nameindex()}.get(ifname)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        # Of two that start at once neither has the bus open yet, so looking for that is not enough.
        try:
            lock.bind(_LOCK.format(index))
        except OSError:
            raise _in_use(ifname) from None
        _check_free(ifname, index)
        _wait_for_carrier(ifname)
        yield


def _check_allowed(ifname: str) -> None:
    if not 0 < len(ifname.encode()) <= MAX_NAME_LENGTH or "/" in ifname:
        raise InterfaceError(
            f"{ifname!r} is no name of a network interface: it must have 1 to {MAX_NAME_LENGTH} characters; "
            "'ip link' lists them"
        )
    if _flags(ifname) & _IFF_LOOPBACK:
        raise InterfaceError(f"{ifname} is the loopback interface: name the one the sensor is connected to")
    missing = _missing_capabilities()
    if missing:
        raise InterfaceError(
            f"not allowed to open {ifname}: {' and '.join(missing)} missing; run with sudo, or "
            "give the service CAP_NET_RAW and CAP_NET_ADMIN"
        )


def _wait_for_carrier(ifname: str) -> None:
    if not is_up(ifname):
        raise InterfaceError(f"{ifname} is down: bring it up with 'sudo ip link set {ifname} up'")
    # A link that was just brought up takes a moment, with a real network card up to some seconds.
    deadline = time.monotonic() + _CARRIER_TIMEOUT_S
    while not _flags(ifname) & _IFF_RUNNING:
        if time.monotonic() < deadline:
            time.sleep(0.02)
            continue
        raise InterfaceError(
            f"{ifname} has no carrier: check the cable, the PoE injector and its power supply"
        )


def check_present(ifname: str, ifindex: int) -> None:
    """Raise InterfaceError unless `ifname` is still the interface that was opened."""
    if (ifindex, ifname) not in socket.if_nameindex():
        raise InterfaceError(f"the interface {ifname} has disappeared: connect it and start the server again")


def _check_free(ifname: str, index: int | None) -> None:
    """Raise InterfaceError if another EtherCAT master has the interface open: two would wreck one another."""
    for line in Path("/proc/self/net/packet").read_text(encoding="ascii").splitlines()[1:]:
        _, _, _, protocol, its_index, *_ = line.split()
        if int(protocol, 16) == _ETHERCAT and int(its_index) == index:
            raise _in_use(ifname)


def _in_use(ifname: str) -> InterfaceError:
    return InterfaceError(f"{ifname} is in use by another EtherCAT master: stop that one first")


def is_up(ifname: str) -> bool:
    """Whether the interface is up; InterfaceError if there is none of this name."""
    return bool(_flags(ifname) & _IFF_UP)


def _flags(ifname: str) -> int:
    # Asked of the kernel, not of /sys: /sys shows the namespace it was mounted in, which may be another.
    request = struct.pack("16sH14x", ifname.encode(), 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            answer = fcntl.ioctl(probe, _SIOCGIFFLAGS, request)
        except OSError:
            names = ", ".join(name for _, name in socket.if_nameindex())
            raise InterfaceError(
                f"no network interface {ifname!r} on this machine: there are {names}"
            ) from None
    flags: int = struct.unpack("16xH14x", answer)[0]
    return flags


def _missing_capabilities() -> list[str]:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            effective = int(line.split()[1], 16)
            return [name for bit, name in _CAPABILITIES.items() if not effective >> bit & 1]
    return []
