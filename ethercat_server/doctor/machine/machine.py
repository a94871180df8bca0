"""The machine as the checks see it: files below a root, which tests replace, and the interface.

Reading is bounded; a file that cannot be read raises CannotLookError with the reason.
"""

from __future__ import annotations

import os
import re
import shlex
import zlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

from ethercat_server.doctor.finding import cannot_look
from ethercat_server.doctor.machine.facts import InterfaceFacts

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
