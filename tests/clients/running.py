"""Runs `ethercat-replay` and `ethercat-record` in threads.

A replay is a server that needs no bus.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self
from unittest import mock

from bota_clients import program as programs
from bota_clients.errors import RecordingError
from bota_clients.program import Signals, start
from bota_clients.record.cli import parse_options as record_options
from bota_clients.recording.reader import open_recording
from bota_clients.replay import program as replay
from bota_clients.replay.cli import parse_options as replay_options
from bota_ethercat.client import Client as StreamClient
from tests.server.running import PATIENCE_S, free_port, wait_until


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


class NoSignals(Signals):
    """Signals that a test gives."""

    def __init__(self) -> None:
        self.asked = False


class Running:
    """A program in a thread, until the end of the block, or until it is stopped."""

    def __init__(self, name: str, options: Namespace) -> None:
        self._name, self._options = name, options
        self._signals = NoSignals()
        self._codes: list[int] = []
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self._codes.append(
            start(f"ethercat-{self._name}", f"{self._name}.program", self._options, self._signals)
        )

    def wait(self) -> int:
        """The exit code, once it has ended."""
        self._thread.join(PATIENCE_S)
        return self._codes[0]

    def stop(self) -> int:
        """As by a signal; the exit code."""
        self._signals.asked = True
        return self.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class Replay(Running):
    """`ethercat-replay` on a free port; the last argument is the file."""

    def __init__(self, *arguments: str | Path, port: int = 0) -> None:
        self.port = port or free_port()
        self._sentences: list[str] = []
        super().__init__("replay", replay_options([*map(str, arguments), "--server", str(self.port)]))
        wait_until(self._is_listening, "a replay that listens")

    def said(self) -> str:
        return "\n".join(self._sentences)

    def _run(self) -> None:
        with (
            mock.patch.object(replay, "_say", self._sentences.append),
            mock.patch.object(programs, "say", self._say),
        ):
            super()._run()

    def _say(self, name: str, sentence: str) -> None:
        """The recorder says its own, on standard error."""
        if name == "ethercat-replay":
            self._sentences.append(sentence)
        else:
            sys.stderr.write(f"{name}: {sentence}\n")

    def _is_listening(self) -> bool:
        assert self._thread.is_alive() or "replaying" in self.said(), self.said()
        return "replaying" in self.said()


def listen(port: int, **options: Any) -> StreamClient:
    """A client that gets every frame, until the connection ends."""
    return StreamClient(port, raw=True, reconnect=False, **options).connect()


class Recorder(Running):
    """`ethercat-record` of what is on `port`."""

    def __init__(self, path: Path, port: int, *arguments: str) -> None:
        self.path = path
        super().__init__("record", record_options([*arguments, str(path), "--server", str(port)]))

    def wait_for_frames(self, count: int) -> None:
        """Until so many more are in the file."""
        enough = frames_in(self.path) + count
        wait_until(lambda: frames_in(self.path) >= enough, "frames")


def frames_in(path: Path) -> int:
    """The number of frames in a recording, which may be being written."""
    try:
        with open_recording(path) as opened:
            return sum(1 for _ in opened.frames())
    except RecordingError:
        return 0
