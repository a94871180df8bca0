"""What ethtool would say of a network interface. Needs no rights.

pyroute2 brings the requests but two, which are here: the driver, and energy-efficient Ethernet
(linux/ethtool.h). Errors are OSErrors, and pyroute2's own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
from array import array
from collections.abc import Iterator
from typing import Any, Final

_SIOCETHTOOL: Final = 0x8946
_GET_DRIVER: Final = 0x03
_GET_EEE: Final = 0x44
_DRIVER: Final = struct.Struct("=I32s32s32s32s32s12sIIIII")
"""Command; driver, version, firmware, bus, ROM; reserved; numbers of statistics and more."""
_EEE: Final = struct.Struct("=IIIIIIIIII")
"""Command; modes supported, advertised, the partner's; active, enabled, low power idle on sending, timer."""
_UNKNOWN_SPEEDS: Final = frozenset({0, 0xFFFF, 0xFFFFFFFF})
_DUPLEX: Final = {0: "half", 1: "full"}


@contextlib.contextmanager
def _ethtool(ifname: str) -> Iterator[Any]:
    from pyroute2.ethtool.ioctl import IoctlEthtool  # noqa: PLC0415 - takes a moment

    with contextlib.closing(IoctlEthtool()) as asked:
        asked.change_ifname(ifname)
        yield asked


def settings(ifname: str) -> tuple[int | None, str | None]:
    """Speed in Mbit/s and duplex; None where it is not known."""
    with _ethtool(ifname) as asked:
        found = asked.get_link_settings()
    return None if found.speed in _UNKNOWN_SPEEDS else int(found.speed), _DUPLEX.get(found.duplex)


def coalescing(ifname: str) -> dict[str, int]:
    """How long the card may hold back that a frame has come or gone, by the kernel's names."""
    with _ethtool(ifname) as asked:
        return {name: int(value) for name, value in asked.get_coalesce().items() if name != "cmd"}


def offloads(ifname: str) -> dict[str, bool]:
    """What the card or the kernel does for TCP and others, by ethtool's names."""
    with _ethtool(ifname) as asked:
        found: dict[str, bool] = asked.get_offload_flags()
    return found


def driver(ifname: str) -> tuple[str, str]:
    """The driver's name, and the bus the card is on."""
    answer = _DRIVER.unpack(_request(ifname, _GET_DRIVER, _DRIVER.size))
    driver, bus = (text.split(b"\0")[0].decode("ascii", errors="replace") for text in (answer[1], answer[4]))
    return driver, bus


def eee(ifname: str) -> tuple[bool, bool]:
    """Whether energy-efficient Ethernet is switched on, and whether it is in use."""
    answer = _EEE.unpack(_request(ifname, _GET_EEE, _EEE.size))
    return bool(answer[5]), bool(answer[4])


def _request(ifname: str, command: int, size: int) -> bytes:
    """An ethtool request through its ioctl, which is given the address of the answer's place."""
    place = array("B", struct.pack("=I", command).ljust(size, b"\0"))
    request = struct.pack("16sP16x", os.fsencode(ifname), place.buffer_info()[0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        fcntl.ioctl(asked, _SIOCETHTOOL, request)
    return place.tobytes()
