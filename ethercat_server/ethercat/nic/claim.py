"""Checks a network interface before the bus is opened on it, and keeps other masters of ours away from it.

SOEM itself would say only that it failed, and open it beside another master.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.nic.interface import ALLOW_IP, find_routes, look_up, network_trouble, trouble
from ethercat_server.ethercat.nic.lock import in_use, locked
from ethercat_server.ethercat.nic.packet_sockets import master_sockets, users_of

MAX_NAME_LENGTH: Final = 15  # Linux's limit; a longer name would overflow SOEM's buffer

_CARRIER_TIMEOUT_S: Final = 5.0
_CAPABILITIES: Final = {12: "CAP_NET_ADMIN", 13: "CAP_NET_RAW"}


@contextlib.contextmanager
def claimed(ifname: str, *, allow_ip: bool = False) -> Iterator[None]:
    """Within it the bus may be opened on `ifname`, by nobody else of this project.

    InterfaceError unless the interface exists, is free, can carry EtherCAT frames, may be opened, and is not
    one of the machine's network, which `allow_ip` permits.
    """
    index = _check_allowed(ifname, allow_ip=allow_ip)
    # Of two that start at once neither has the bus open yet, so looking for that is not enough.
    with locked(ifname, index):
        if inodes := master_sockets(ifname):
            raise in_use(ifname, next((process.pid for process in users_of(inodes)), 0))
        _wait_usable(ifname)
        yield


def _check_allowed(ifname: str, *, allow_ip: bool) -> int:
    if not 0 < len(ifname.encode()) <= MAX_NAME_LENGTH or "/" in ifname:
        raise InterfaceError(
            f"{ifname!r} is no name of a network interface: it must have 1 to {MAX_NAME_LENGTH} characters; "
            "'ip link' lists them"
        )
    found = look_up(ifname)
    if found.is_loopback:
        raise InterfaceError(f"{ifname} is the loopback interface: name the one the sensor is connected to")
    if not allow_ip:
        try:
            routes = find_routes(ifname)
        except OSError as error:
            raise InterfaceError(
                f"the kernel does not say whether {ifname} has an IP address ({error}): {ALLOW_IP} "
                "uses it all the same"
            ) from None
        if problem := network_trouble(ifname, routes):
            raise InterfaceError(problem)
    if missing := _missing_capabilities():
        raise InterfaceError(
            f"not allowed to open {ifname}: {' and '.join(missing)} missing; run with sudo, or "
            "give the service CAP_NET_RAW and CAP_NET_ADMIN"
        )
    return found.ifindex


def _wait_usable(ifname: str) -> None:
    # A link that was just brought up takes a moment, with a real network card up to some seconds.
    deadline = time.monotonic() + _CARRIER_TIMEOUT_S
    while (found := look_up(ifname)).is_up and not found.has_carrier and time.monotonic() < deadline:
        time.sleep(0.02)
    if problem := trouble(ifname):
        raise InterfaceError(problem)


def _missing_capabilities() -> list[str]:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            effective = int(line.split()[1], 16)
            return [name for bit, name in _CAPABILITIES.items() if not effective >> bit & 1]
    return []
