"""What `ethercat-record` does: connects, records until it is stopped, reports what it recorded and lost.

Progress is on standard error: one line that is updated on a terminal, else a line every ten seconds.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from datetime import UTC, datetime
from functools import partial
from typing import Final

from rich.console import Console
from rich.filesize import decimal
from rich.live import Live
from rich.text import Text

from bota_clients.errors import RecordingError
from bota_clients.numbers import count, duration
from bota_clients.program import Signals, say
from bota_clients.record.cli import RecordOptions
from bota_clients.record.recorder import BATCH_S, Batch, Parts, Recorder, Source
from bota_clients.recording.file_format import FORMAT_VERSION
from bota_clients.recording.reader import Event
from bota_ethercat.errors import ConnectionFailedError, RefusedError, UnreachableError
from bota_ethercat.program.version import VERSION
from bota_ethercat.text.untrusted import printable

_WAIT_S: Final = 0.2
_LINE_EVERY_S: Final = 10.0
_SHOW_EVERY_S: Final = 0.5
_NAME: Final = f"ethercat-record {VERSION}"

_say = partial(say, "ethercat-record")


class Progress:
    """The progress line. On a terminal `live` is to be entered meanwhile."""

    def __init__(self, name: str, seconds: float | None = None) -> None:
        """For a recording of so many seconds, if there is a limit."""
        self._name = name
        self._of = "" if seconds is None else f" of {duration(seconds)}"
        self._console = Console(stderr=True, highlight=False)
        terminal = self._console.is_terminal
        self.live = Live(console=self._console, auto_refresh=False, transient=True) if terminal else None
        self._every_s = _SHOW_EVERY_S if terminal else _LINE_EVERY_S
        self._began = self._seen_at = time.monotonic()
        self._seen: dict[int, int] = {}

    def say(self, sentence: str) -> None:
        """Print a sentence above the progress line."""
        self._console.print(sentence, markup=False, soft_wrap=True)

    def show(self, recorder: Recorder, *, connected: bool) -> None:
        """Update the progress if it is due."""
        passed = time.monotonic() - self._seen_at
        if passed < self._every_s or not (connected or self.live):  # the disconnect was reported already
            return
        rates = []
        for position, sensor in recorder.tally.sensors.items():
            rates.append(f"{(sensor.frames - self._seen.get(position, 0)) / passed:.0f}")
            self._seen[position] = sensor.frames
        self._seen_at += passed
        state = f"{' + '.join(rates) or '0'} frames/s" if connected else "no server, reconnecting"
        size, lost = decimal(recorder.bytes_written), recorder.tally.losses()
        whole = duration(self._seen_at - self._began) + self._of
        line = f"{self._name}: {whole}, {recorder.saved} frames, {size}, {state}, {lost}"
        if self.live:
            self.live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
        else:
            self.say(line)


def run(options: RecordOptions, signals: Signals) -> int:
    """Record; returns the exit code."""
    if options.until_eof:
        _stop_at_eof(signals)
    parts = Parts(options.path, options.rotate_size, options.rotate_seconds, overwrite=options.force)
    with contextlib.closing(Source(options.address, options.sensors)) as source:
        try:
            parts.check()
            connected = _connect(source, options, signals)
        except UnreachableError as error:
            raise RecordingError(f"{error.at(options.address)}, or use --wait") from None
        except RefusedError as error:
            raise RecordingError(f"the server refused: {error}") from None
        if not connected:
            _say("stopped before the server started; nothing was recorded")
            return 0
        return _record(source, options, parts, signals)


def _connect(source: Source, options: RecordOptions, signals: Signals) -> bool:
    """False if it was stopped before."""
    waiting = False
    while True:
        try:
            source.connect()
            return True
        except ConnectionFailedError:
            if not options.wait:
                raise
        if not waiting:
            _say(f"waiting for a server at {options.address}")
            waiting = True
        if signals.asked:
            return False
        time.sleep(_WAIT_S)


def _record(source: Source, options: RecordOptions, parts: Parts, signals: Signals) -> int:
    recorder = Recorder(parts, _NAME, _notes(options, source))
    progress = Progress(options.path.name, options.seconds)
    began, reason = time.monotonic(), "asked to stop"
    with progress.live or contextlib.nullcontext():
        progress.say(f"recording {options.address} to {parts.made[0]}; Ctrl-C ends it")
        while True:
            batch = source.batch()
            recorder.put(batch)
            _report(batch, progress)
            connected = source.session.connected
            if recorder.failed or signals.asked:
                break
            if options.seconds is not None and time.monotonic() - began >= options.seconds:
                reason = "time is up"
                break
            if not (connected or options.reconnect):
                reason = "the server ended"
                break
            progress.show(recorder, connected=connected)
            time.sleep(BATCH_S)
        seconds = time.monotonic() - began
        source.close()
        recorder.stop(reason)
    if recorder.error is not None:
        _say(str(recorder.error))
    files = str(parts.made[0]) if len(parts.made) == 1 else f"{parts.made[0]} to {parts.made[-1].name}"
    frames = f"{recorder.saved} frames of {count(len(recorder.tally.sensors), 'sensor')}"
    size, lost = decimal(recorder.bytes_written), recorder.tally.losses()
    _say(f"{files}: {duration(seconds)}, {frames}, {size}; {lost}")
    return int(recorder.error is not None)


def _stop_at_eof(signals: Signals) -> None:
    """Wait for the end of standard input. A thread: Windows has no `select` for it."""

    def read() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 4096):
                pass
        signals.asked = True

    threading.Thread(target=read, name="stdin", daemon=True).start()


def _report(batch: Batch, progress: Progress) -> None:
    for item in batch:
        if isinstance(item, Event):
            row = item.event
            words = row.get("message") or row.get("reason") or ""
            position = f" {row['sensor']}" if "sensor" in row else ""
            if item.name != "connected" or words:
                progress.say(printable(f"{item.name}{position}{': ' if words else ''}{words}", 300))


def _notes(options: RecordOptions, source: Source) -> dict[str, str]:
    return {
        "format": FORMAT_VERSION,
        "recorder": _NAME,
        "server": str(options.address),
        "server_version": printable(source.description.get("version"), 40),
        "host": socket.gethostname(),
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **({"sensors": " ".join(map(str, options.sensors))} if options.sensors else {}),
    }
