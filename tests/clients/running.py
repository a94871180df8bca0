"""Runs `ethercat-replay` and `ethercat-record` in threads and as processes.

A replay is a server that needs no bus. A thread is enough wherever a test is about what is sent or written;
a process is for what others do to it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from bota_clients.program import Signals
from bota_clients.record import program as record
from bota_clients.recording.reader import RecordingError, open_recording
from bota_clients.replay import program
from bota_ethercat.client import Client as StreamClient
from tests.server.running import PATIENCE_S, Program, free_port, wait_until


class NoSignals(Signals):
    """Signals that a test gives."""

    def __init__(self) -> None:
        self.asked = False
        self._stop: Callable[[], None] | None = None

    def give(self) -> None:
        self.asked = True
        if self._stop is not None:
            self._stop()


def signalled(
    main: Callable[[Sequence[str]], int], number: int, ready: Callable[[], bool], *argv: object
) -> int:
    """The exit code of a program that runs here until it is `ready` and gets a signal."""

    def give() -> None:
        wait_until(ready, "the program")
        os.kill(os.getpid(), number)

    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    giver = threading.Thread(target=give)
    giver.start()
    try:
        return main([*map(str, argv)])
    finally:
        giver.join()
        for each, handler in handlers.items():
            signal.signal(each, handler)


class Replay:
    """`ethercat-replay` of a file on a free port, in a thread."""

    def __init__(self, *arguments: str | Path, port: int = 0) -> None:
        self.port = port or free_port()
        self._argv = [*map(str, arguments), str(self.port)]
        self._sentences: list[str] = []
        self._signals = NoSignals()
        self._codes: list[int] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        wait_until(self._is_listening, "a replay that listens")

    def said(self) -> str:
        return "\n".join(self._sentences)

    def wait(self) -> int:
        self._thread.join(PATIENCE_S)
        return self._codes[0]

    def close(self) -> None:
        self._signals.give()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        with mock.patch.object(program, "_say", self._sentences.append):
            self._codes.append(program.run(self._argv, self._signals))

    def _is_listening(self) -> bool:
        assert self._thread.is_alive() or "replaying" in self.said(), self.said()
        return "replaying" in self.said()


def listen(port: int, **options: Any) -> StreamClient:
    """A client that gets every frame, until the connection ends."""
    return StreamClient(port, raw=True, reconnect=False, **options).connect()


@contextlib.contextmanager
def replaying(*arguments: str | Path, port: int = 0) -> Iterator[Replay]:
    """A replay of `arguments`, the last of which is the file, until the end of the block."""
    running = Replay(*arguments, port=port)
    try:
        yield running
    finally:
        running.close()


class Recorder:
    """`ethercat-record` of what is on `port`, in a thread."""

    def __init__(self, path: Path, port: int, *arguments: str) -> None:
        self.path = path
        self._argv = [*arguments, str(path), str(port)]
        self._signals = NoSignals()
        self._codes: list[int] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self._codes.append(record.run(self._argv, self._signals))

    def wait_for_frames(self, count: int) -> None:
        """Until so many more are in the file."""
        enough = frames_in(self.path) + count
        wait_until(lambda: frames_in(self.path) >= enough, "frames")

    def wait(self) -> int:
        """The exit code, once it has ended."""
        self._thread.join(PATIENCE_S)
        return self._codes[0]

    def stop(self) -> int:
        """As by a signal; the exit code."""
        self._signals.give()
        return self.wait()


@contextlib.contextmanager
def recording(path: Path, port: int, *arguments: str) -> Iterator[Recorder]:
    """A recorder until the end of the block, or until it is stopped."""
    running = Recorder(path, port, *arguments)
    try:
        yield running
    finally:
        running.stop()


def frames_in(path: Path) -> int:
    """The number of frames in a recording, which may be being written."""
    try:
        with open_recording(path) as opened:
            return sum(1 for _ in opened.frames())
    except RecordingError:
        return 0


class RecorderProcess(Program):
    """`ethercat-record` of what is on `port`, as a process."""

    def __init__(self, path: Path, port: int, *arguments: str) -> None:
        super().__init__("bota_clients.record.cli", [*arguments, str(path), str(port)])
