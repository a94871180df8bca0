"""The hub's seam to the network. `sockets` is behind it in a server, `in_memory` in a test.

Nothing here waits except `Transport.wait`. Errors are those of a non-blocking socket: BlockingIOError for
what cannot be done yet, any other OSError for a connection that is broken.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol


class Stream(Protocol):
    """One client's connection."""

    peer: str
    """The client's address and port."""

    def recv(self, size: int, /) -> bytes:
        """Up to `size` bytes that have arrived; b"" once the peer has closed its side."""
        ...

    def send(self, data: bytes | memoryview, /) -> int:
        """Send as much as can be sent now; returns the number of bytes."""
        ...

    def fileno(self) -> int:
        """What `Transport.wait` calls it."""
        ...

    def peer_uid(self) -> int | None:
        """The user who owns the other end, None if that cannot be established."""
        ...

    def end_sending(self) -> None:
        """Close this side; the peer may still send."""
        ...

    def close(self) -> None:
        """Close both sides."""
        ...


class Transport(Protocol):
    """Where clients come from."""

    def listening(self) -> Sequence[int]:
        """File descriptors that are readable when a client wants to connect."""
        ...

    def accept(self, fd: int) -> Stream | None:
        """The next client that wants to connect to `fd`, None if there is none."""
        ...

    def wait(
        self, readers: Collection[int], writers: Collection[int], seconds: float
    ) -> tuple[Sequence[int], Sequence[int]]:
        """Which of these can be read and written; waits up to `seconds` until there is at least one."""
        ...

    def stop_listening(self) -> None:
        """Refuse new clients."""
        ...

    def close(self) -> None:
        """Release everything but the connections."""
        ...
