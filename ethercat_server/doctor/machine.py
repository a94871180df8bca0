"""The machine as the checks see it: files below a root, which tests replace, and properties of the network
interface.

Reading of files is bounded; one that cannot be read raises CannotLookError with the reason. The
interface's properties come from the kernel by netlink and ethtool requests, which need no rights, not from
/sys, which shows the network namespace that it was mounted in.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import shlex
import socket
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from ethercat_server.access.adapters import is_local, kind, open_routes
from ethercat_server.doctor.finding import cannot_look
from ethercat_server.ethercat.nic import Routes, find_routes

_IFF_UP, _IFF_LOOPBACK = 0x1, 0x8
_NO_SUPPORT: Final = "the driver does not support it"
_UNKNOWN_SPEEDS: Final = frozenset({0, 0xFFFF, 0xFFFFFFFF})
_DUPLEX: Final = {0: "half", 1: "full"}
# Requests that pyroute2 lacks, from linux/ethtool.h.
_GET_DRIVER: Final = 0x03, struct.Struct("=4x32s32x32x32s64x")
"""Driver, bus."""
_GET_EEE: Final = 0x44, struct.Struct("=16xII16x")
"""Active, enabled."""


@dataclass(frozen=True)
class Link:
    """The interface itself."""

    index: int
    kind: str = ""
    """Of a virtual one, such as veth or bridge; empty for a network card."""
    up: bool = True
    carrier: bool = True
    loopback: bool = False
    master: str = ""
    """Bridge or bond that it is a part of."""
    upper: tuple[str, ...] = ()
    """Interfaces that stand on it, such as VLANs."""
    parent: str = ""
    """Device behind it, by the kernel's name, such as 0000:00:1f.6 or virtio2."""
    counters: dict[str, int] = field(default_factory=dict)
    carrier_changes: int | None = None


@dataclass(frozen=True)
class InterfaceFacts:
    """What is known; each part is a sentence instead where it could not be asked for."""

    link: Link | str | None = None
    """None: there is no such interface."""
    names: tuple[str, ...] = ()
    """The interfaces that there are."""
    routes: Routes | str = "not asked"
    settings: tuple[int | None, str | None] | str = "not asked"
    """Speed in Mbit/s and duplex."""
    driver: tuple[str, str] | str = "not asked"
    """Its name, and the bus the card is on."""
    coalescing: dict[str, int] | str = "not asked"
    offloads: dict[str, bool] | str = "not asked"
    eee: tuple[bool, bool] | str = "not asked"
    """Whether it is switched on, and in use."""

    @property
    def there(self) -> Link:
        """The interface; CannotLookError if there is none."""
        if self.link is None:
            cannot_look("there is no such interface")
        there: Link = known(self.link)
        return there


def known(part: Any) -> Any:
    """A part of the facts; CannotLookError with its sentence if it is not known."""
    return cannot_look(part) if isinstance(part, str) else part


def collect(ifname: str) -> InterfaceFacts:
    """Everything about `ifname`; never an exception."""
    names = tuple(name for _, name in socket.if_nameindex())
    if ifname not in names:
        return InterfaceFacts(names=names)
    return InterfaceFacts(
        link=_asked(_link, ifname),
        names=names,
        routes=_asked(find_routes, ifname),
        settings=_asked(_settings, ifname),
        driver=_asked(_driver, ifname),
        coalescing=_asked(_coalescing, ifname),
        offloads=_asked(_offloads, ifname),
        eee=_asked(_eee, ifname),
    )


def _asked(ask: Callable[[str], Any], ifname: str) -> Any:
    try:
        return ask(ifname)
    except OSError as error:
        return _NO_SUPPORT if error.errno == errno.EOPNOTSUPP else error.strerror or str(error)
    except Exception as error:  # noqa: BLE001 - pyroute2's errors share no base, and no part spoils the others
        name = type(error).__name__
        return _NO_SUPPORT if name == "NotSupportedError" else f"{name}: {error}".replace("\0", "").strip()


@contextlib.contextmanager
def _ethtool(ifname: str) -> Iterator[Any]:
    from pyroute2.ethtool.ioctl import IoctlEthtool  # noqa: PLC0415 - takes a moment

    with contextlib.closing(IoctlEthtool(ifname)) as asked:
        yield asked


def _settings(ifname: str) -> tuple[int | None, str | None]:
    with _ethtool(ifname) as asked:
        found = asked.get_link_settings()
    return None if found.speed in _UNKNOWN_SPEEDS else int(found.speed), _DUPLEX.get(found.duplex)


def _coalescing(ifname: str) -> dict[str, int]:
    with _ethtool(ifname) as asked:
        return {name: int(value) for name, value in asked.get_coalesce().items() if name != "cmd"}


def _offloads(ifname: str) -> dict[str, bool]:
    with _ethtool(ifname) as asked:
        found: dict[str, bool] = asked.get_offload_flags()
    return found


def _driver(ifname: str) -> tuple[str, str]:
    texts = _request(ifname, *_GET_DRIVER)
    driver, bus = (text.split(b"\0")[0].decode("ascii", errors="replace") for text in texts)
    return driver, bus


def _eee(ifname: str) -> tuple[bool, bool]:
    active, enabled = _request(ifname, *_GET_EEE)
    return bool(enabled), bool(active)


def _request(ifname: str, command: int, layout: struct.Struct) -> tuple[Any, ...]:
    buffer = ctypes.create_string_buffer(struct.pack("=I", command), layout.size)
    with _ethtool(ifname) as asked:
        asked.ifreq.gstats = ctypes.cast(buffer, ctypes.c_void_p)
        asked.ioctl()
    return layout.unpack(buffer.raw)


def _links() -> dict[int, Any]:
    with open_routes() as route:
        return {row["index"]: row for row in route.get_links()}


def _link(ifname: str) -> Link:
    everyone, index = _links(), socket.if_nametoindex(ifname)
    own = everyone[index]
    upper = [r for r in everyone.values() if r.get_attr("IFLA_LINK") == index and is_local(r)]
    master = everyone.get(own.get_attr("IFLA_MASTER"))
    up = bool(own["flags"] & _IFF_UP)
    stats = own.get_attr("IFLA_STATS64") or own.get_attr("IFLA_STATS") or {}
    return Link(
        index=index,
        kind=kind(own),
        up=up,
        carrier=up and own.get_attr("IFLA_CARRIER") == 1,
        loopback=bool(own["flags"] & _IFF_LOOPBACK),
        master=master.get_attr("IFLA_IFNAME") if master else "",
        upper=tuple(row.get_attr("IFLA_IFNAME") for row in upper if row["index"] != index),
        parent=own.get_attr("IFLA_PARENT_DEV_NAME") or "",
        counters={name: int(stats[name]) for name in stats.keys() if isinstance(stats[name], int)},  # noqa: SIM118
        carrier_changes=own.get_attr("IFLA_CARRIER_CHANGES"),
    )


def read_counters(ifname: str) -> dict[str, int]:
    """The present counters of `ifname`; empty if they cannot be read."""
    link = _asked(_link, ifname)
    return dict(link.counters) if isinstance(link, Link) else {}


_MOST_BYTES: Final = 4 << 20
_PART_BYTES: Final = 1 << 16
_MOST_PROCESSORS: Final = 8192


@dataclass
class Machine:
    """One machine, and the interface in question."""

    ifname: str
    asked: str = ""
    """The name on the command line if it differs: virtual."""
    facts: InterfaceFacts = field(default_factory=InterfaceFacts)
    root: Path = Path("/")
    timer_resolution_s: float = 1e-9
    """Resolution of CLOCK_MONOTONIC's timers."""
    release: str = field(default_factory=lambda: os.uname().release)
    rt_priority: int = 80
    """The server's real-time priority."""
    allow_ip: bool = False
    """Whether an interface of the machine's network may be used."""

    @property
    def shown(self) -> str:
        """The interface's name as it goes into a command."""
        return shlex.quote(self.ifname)

    def path(self, name: str) -> Path:
        """The file `name`, written as an absolute one."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """Content of a file, stripped; CannotLookError if it cannot be read."""
        try:
            return _text(self._read(name))
        except OSError as error:
            cannot_look(f"{name}: {error.strerror or error}")

    def text_or(self, name: str, default: str = "") -> str:
        """The same; `default` if there is no such file or it cannot be read."""
        try:
            return _text(self._read(name))
        except OSError:
            return default

    def _read(self, name: str) -> bytes:
        found = b""
        # In small parts: some files in /proc refuse to be read into a large place.
        with self.path(name).open("rb", buffering=0) as file:
            while len(found) < _MOST_BYTES and (part := file.read(_PART_BYTES)):
                found += part
        return found

    def number(self, name: str) -> int:
        """A whole number; CannotLookError if it is none."""
        text = self.text(name)
        try:
            return int(text)
        except ValueError:
            cannot_look(f"{name} contains {text[:40]!r}, which is not a number")

    def names(self, name: str) -> list[str]:
        """Entries of a folder, sorted; empty if there is no such folder."""
        try:
            return sorted(entry.name for entry in self.path(name).iterdir())
        except OSError:
            return []

    @cached_property
    def config(self) -> dict[str, str]:
        """The kernel's build options without CONFIG_; empty if unknown."""
        text = ""
        try:
            # Bounded: a made-up file could unpack to anything.
            unpacked = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(
                self._read("/proc/config.gz"), _MOST_BYTES
            )
            text = unpacked.decode("utf-8", errors="replace")
        except (OSError, zlib.error):
            text = self.text_or(f"/boot/config-{self.release}")
        return dict(re.findall(r"^CONFIG_(\w+)=(.*)$", text, re.MULTILINE))

    @cached_property
    def command_line(self) -> dict[str, str]:
        """The kernel's command line; options without a value have an empty one."""
        return {
            word.partition("=")[0]: word.partition("=")[2] for word in self.text_or("/proc/cmdline").split()
        }

    @cached_property
    def processors(self) -> list[int]:
        """The online processors; CannotLookError if unknown."""
        return processor_list(self.text("/sys/devices/system/cpu/online"))

    @cached_property
    def status(self) -> dict[str, str]:
        """This process's status, by the kernel's names."""
        rows = (line.partition(":") for line in self.text("/proc/self/status").splitlines())
        return {name: value.strip() for name, _, value in rows}

    def has_capability(self, bit: int) -> bool:
        """Whether this process has a capability."""
        try:
            return bool(int(self.status["CapEff"], 16) >> bit & 1)
        except (KeyError, ValueError):
            cannot_look("/proc/self/status does not list capabilities")

    def commands_running(self) -> dict[int, str]:
        """The visible processes by PID, with their short names."""
        found = {
            int(name): self.text_or(f"/proc/{name}/comm") for name in self.names("/proc") if name.isdecimal()
        }
        return {pid: name for pid, name in found.items() if name}


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", errors="replace").strip().strip("\0")


def processor_list(text: str) -> list[int]:
    """The numbers in a list as the kernel writes it, such as 0-2,5; CannotLookError if it is none."""
    found: list[int] = []
    for part in filter(None, text.strip().split(",")):
        match = re.fullmatch(r"(\d{1,5})(?:-(\d{1,5}))?", part)
        if match is None or int(match[2] or match[1]) > _MOST_PROCESSORS:
            cannot_look(f"{text[:40]!r} is not a list of processors")
        found.extend(range(int(match[1]), int(match[2] or match[1]) + 1))
    return found


def as_list(numbers: list[int]) -> str:
    """Such a list, the other way round."""
    parts: list[str] = []
    start = previous = None
    for number in [*sorted(set(numbers)), None]:
        if start is not None and previous is not None and number != previous + 1:
            parts.append(str(start) if start == previous else f"{start}-{previous}")
            start = number
        elif start is None:
            start = number
        previous = number
    return ",".join(parts)
