"""HOST:PORT as written on a command line."""

from __future__ import annotations

from typing import Final, NamedTuple

DEFAULT_HOST: Final = "localhost"
DEFAULT_PORT: Final = 12001


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
        bracketed = host.startswith("[") and host.endswith("]")
        if ":" in host and not bracketed:
            raise ValueError(f"{text!r}: write an IPv6 address in brackets, for example [::1]:{DEFAULT_PORT}")
        if not port.isdecimal() or not port.isascii() or not 1 <= int(port) <= 65535:
            raise ValueError(f"{text!r}: it must be HOST:PORT, for example {DEFAULT_HOST}:{DEFAULT_PORT}")
        return cls(host.strip("[]") or DEFAULT_HOST, int(port))

    def __str__(self) -> str:
        """As written on a command line."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"
