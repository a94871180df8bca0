"""Runs `ethercat-record` and `ethercat-replay` as processes. A replay is a server that needs no bus."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from tests.server.running import Client, Program, free_port, wait_until

__all__ = ["Client", "Program", "Recorder", "Replay", "free_port", "replaying", "wait_until"]


class Replay(Program):
    """`ethercat-replay` of a file on a free port."""

    def __init__(self, *arguments: str | Path, port: int = 0) -> None:
        self.port = port or free_port()
        super().__init__("clients.replay.cli", [*map(str, arguments), str(self.port)])

    def wait_listening(self) -> Replay:
        self.wait_for("replaying")
        return self


@contextlib.contextmanager
def replaying(*arguments: str | Path, port: int = 0) -> Iterator[Replay]:
    """A replay of `arguments`, the last of which is the file, until the end of the block."""
    running = Replay(*arguments, port=port)
    try:
        yield running.wait_listening()
    finally:
        running.close()


class Recorder(Program):
    """`ethercat-record` of what is on `port`."""

    def __init__(self, path: Path, port: int, *arguments: str) -> None:
        self.path = path
        super().__init__("clients.recording.cli", [*arguments, str(path), str(port)])

    def size(self) -> int:
        return self.path.stat().st_size if self.path.exists() else 0
