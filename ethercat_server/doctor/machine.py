"""The machine as the checks see it: files below a root, and facts about the network interface; tests replace
both.

Reading of files is bounded. What cannot be read or asked raises CannotLookError with the reason. The facts
come from the kernel by netlink and ethtool requests, which need no rights, not from /sys, which shows the
network namespace that it was mounted in.
"""

from __future__ import annotations

import errno
import re
import shlex
import socket
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from ethercat_server.access.adapters import Adapter, links
from ethercat_server.doctor.report import CannotLookError
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.nic import ethtool, find_routes, in_between, link_settings, look_up, receivers

NOT_SUPPORTED: Final = "the driver does not support it"
_DUPLEX: Final = {0: "half", 1: "full"}
# Requests of linux/ethtool.h: number, and layout of the answer.
_GET_DRIVER: Final = 0x03, struct.Struct("=4x32s32x32x32s64x")  # driver, bus
_GET_COALESCING: Final = 0x0E, struct.Struct("=4xI12xI16xII44x")
_COALESCING: Final = (
    "rx_coalesce_usecs", "tx_coalesce_usecs", "use_adaptive_rx_coalesce", "use_adaptive_tx_coalesce",
)  # fmt: skip
_GET_EEE: Final = 0x44, struct.Struct("=16xII16x")  # active, enabled


def _settings(ifname: str) -> tuple[int | None, str | None]:
    mbits, duplex = link_settings(ifname)
    return mbits or None, _DUPLEX.get(duplex)


def _driver(ifname: str) -> tuple[str, ...]:
    texts = ethtool(ifname, *_GET_DRIVER)
    return tuple(text.split(b"\0")[0].decode("ascii", errors="replace") for text in texts)


FACTS: Final[Mapping[str, Callable[[str], Any]]] = {
    "link": lambda ifname: next((row for row in links() if row.name == ifname), None),
    "names": lambda _: [name for _, name in socket.if_nameindex()],
    "routes": lambda ifname: find_routes(look_up(ifname).ifindex),
    "settings": _settings,  # speed in Mbit/s and duplex
    "driver": _driver,  # its name, and the bus the card is on
    "coalescing": lambda ifname: dict(zip(_COALESCING, ethtool(ifname, *_GET_COALESCING), strict=True)),
    # Processes with a copy of all frames, None for one of another user, and whether of this interface alone.
    "receivers": lambda ifname: list(receivers(look_up(ifname).ifindex)),
    "between": lambda ifname: (in_between(ifname) or "").split(": ", 1),  # what is there; what to do
    "EEE": lambda ifname: tuple(map(bool, ethtool(ifname, *_GET_EEE)))[::-1],  # switched on, in use
}

_MOST_BYTES: Final = 4 << 20
_PART_BYTES: Final = 1 << 16
_MOST_PROCESSORS: Final = 8192


@dataclass
class Host:
    """One machine, and the interface in question."""

    ifname: str
    asked: str = ""  # the name on the command line if it differs: virtual
    facts: dict[str, Any] = field(default_factory=dict)  # those that are known, or why they are not
    root: Path = Path("/")
    rt_priority: int = 80  # the server's
    cpu: int | None = None  # likewise
    allow_ip: bool = False  # whether an interface of the machine's network may be used

    @property
    def shown(self) -> str:
        """The interface's name as it goes into a command."""
        return shlex.quote(self.ifname)

    def fact(self, name: str) -> Any:
        """One of FACTS; asked for once."""
        if name not in self.facts:
            try:
                self.facts[name] = FACTS[name](self.ifname)
            except (OSError, struct.error, InterfaceError) as error:
                lacks = getattr(error, "errno", 0) == errno.EOPNOTSUPP
                text = NOT_SUPPORTED if lacks else getattr(error, "strerror", None) or str(error)
                self.facts[name] = CannotLookError(text)
        found = self.facts[name]
        if isinstance(found, CannotLookError):
            raise CannotLookError(str(found))
        return found

    @property
    def link(self) -> Adapter:
        found: Adapter | None = self.fact("link")
        if found is None:
            raise CannotLookError("there is no such interface")
        return found

    def path(self, name: str) -> Path:
        """The file `name`, written as an absolute one."""
        return self.root / name.lstrip("/")

    def text(self, name: str, default: str | None = None) -> str:
        """Content of a file, stripped; `default`, if there is one, where it cannot be read."""
        found = b""
        try:
            # In small parts: some files in /proc refuse to be read into a large place.
            with self.path(name).open("rb", buffering=0) as file:
                while len(found) < _MOST_BYTES and (part := file.read(_PART_BYTES)):
                    found += part
        except OSError as error:
            if default is None:
                raise CannotLookError(f"{name}: {error.strerror or error}") from None
            return default
        return found.decode("utf-8", errors="replace").strip().strip("\0")

    def number(self, name: str) -> int:
        text = self.text(name)
        try:
            return int(text)
        except ValueError:
            raise CannotLookError(f"{name} contains {text[:40]!r}, which is not a number") from None

    def names(self, name: str) -> list[str]:
        """Entries of a folder, sorted; empty if there is no such folder."""
        try:
            return sorted(entry.name for entry in self.path(name).iterdir())
        except OSError:
            return []

    @cached_property
    def processors(self) -> list[int]:
        return processor_list(self.text("/sys/devices/system/cpu/online"))


def processor_list(text: str) -> list[int]:
    """The numbers in a list as the kernel writes it, such as 0-2,5; CannotLookError if it is none."""
    found: list[int] = []
    for part in filter(None, text.strip().split(",")):
        match = re.fullmatch(r"(\d{1,5})(?:-(\d{1,5}))?", part)
        if match is None or int(match[2] or match[1]) > _MOST_PROCESSORS:
            raise CannotLookError(f"{text[:40]!r} is not a list of processors")
        found.extend(range(int(match[1]), int(match[2] or match[1]) + 1))
    return found
