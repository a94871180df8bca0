# SPDX-License-Identifier: Apache-2.0
"""Where a server is: HOST:PORT as written on a command line, and whose CLOCK_MONOTONIC it has."""

from __future__ import annotations

import functools
import os
import uuid
from pathlib import Path
from typing import Final, NamedTuple

from bota_ethercat.option_types import integer

DEFAULT_HOST: Final = "localhost"
DEFAULT_PORT: Final = 12001
PORT: Final = integer(1, 65535)

_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")
_CLOCK_OFFSETS: Final = Path("/proc/self/timens_offsets")


class Address(NamedTuple):
    """Where a server listens."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse HOST:PORT, HOST, :PORT or PORT, an IPv6 address in brackets; ValueError for anything else."""
        host, colon, port = text.rpartition(":")
        if text.isdecimal():
            host, port = "", text
        elif not colon or text.endswith("]"):
            host, port = text, str(DEFAULT_PORT)
        if ":" in host and not (host.startswith("[") and host.endswith("]")):
            raise ValueError(f"{text!r}: write an IPv6 address in brackets, for example [::1]:{DEFAULT_PORT}")
        if not port.isdecimal() or not port.isascii():
            raise ValueError(f"{text!r}: it must be HOST:PORT, for example {DEFAULT_HOST}:{DEFAULT_PORT}")
        try:
            return cls(host.strip("[]") or DEFAULT_HOST, PORT.check(int(port)))
        except ValueError as error:
            raise ValueError(f"{text!r}: {port} is no port: it must be {error}") from None

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


@functools.cache
def boot_id() -> str | None:
    """The name of this process's CLOCK_MONOTONIC, `boot_id` in messages; None if it cannot be known.

    The kernel's boot id: processes with the same one have the same clock. In a time namespace that shifts
    the clock the offset follows, in s and ns.
    """
    try:
        text = _BOOT_ID.read_text()
    except OSError:  # hidden by ProcSubset=pid; the unit has it from systemd
        text = os.environ.get("BOOT_ID", "")
    try:
        name = str(uuid.UUID(text.strip()))
        offsets = dict(line.split(maxsplit=1) for line in _CLOCK_OFFSETS.read_text().splitlines())
        seconds, ns = map(int, offsets["monotonic"].split())
    except FileNotFoundError:  # a kernel without time namespaces
        return name
    except (OSError, ValueError, KeyError):
        return None
    return f"{name} {seconds} {ns}" if seconds or ns else name
