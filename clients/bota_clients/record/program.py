"""What `ethercat-record` does: connects, records until it is stopped, reports what it recorded and lost.

Progress is on standard error: one line that is updated on a terminal, else a line every ten seconds.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

from bota_clients.errors import RecordingError
from bota_clients.numbers import count, data_size, duration
from bota_clients.program import Signals, say
from bota_clients.record.options import RecordOptions, parse_options
from bota_clients.record.recorder import Parts, Recorder
from bota_clients.record.source import Batch, Source
from bota_clients.recording.file_format import FORMAT_VERSION
from bota_clients.recording.reader import Event
from bota_ethercat.errors import ConnectionFailedError, ProtocolError, RefusedError, UnreachableError
from bota_ethercat.program.version import VERSION
from bota_ethercat.text.untrusted import printable

_LINE_EVERY_S: Final = 10.0
_SHOW_EVERY_S: Final = 0.5


class Progress:
    """The progress line."""

    def __init__(self, name: str, seconds: float | None = None) -> None:
        """For a recording of so many seconds, if there is a limit."""
        self._name = name
        self._of = "" if seconds is None else f" of {duration(seconds)}"
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._began = time.monotonic()
        self._next = self._began + (_SHOW_EVERY_S if self._console.is_terminal else _LINE_EVERY_S)
        self._seen: dict[int, int] = {}
        self._seen_at = self._began

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def say(self, sentence: str) -> None:
        """Print a sentence above the progress line."""
        self._console.print(sentence, markup=False, soft_wrap=True)

    def show(self, recorder: Recorder, *, connected: bool) -> None:
        """Update the progress if it is due."""
        now = time.monotonic()
        if now < self._next:
            return
        terminal = self._console.is_terminal
        if not (connected or terminal):
            return  # the disconnect was reported already
        self._next = now + (_SHOW_EVERY_S if terminal else _LINE_EVERY_S)
        line = self._line(recorder, now, connected=connected)
        if terminal:
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
        else:
            self.say(line)

    def _line(self, recorder: Recorder, now: float, *, connected: bool) -> str:
        rates = []
        for position, sensor in sorted(dict(recorder.tally.sensors).items()):
            rate = (sensor.frames - self._seen.get(position, 0)) / (now - self._seen_at)
            self._seen[position] = sensor.frames
            rates.append(f"{rate:.0f}")
        self._seen_at = now
        state = f"{' + '.join(rates) or '0'} frames/s" if connected else "no server, reconnecting"
        size, lost = data_size(recorder.bytes_written), recorder.tally.brief()
        passed = duration(now - self._began) + self._of
        return f"{self._name}: {passed}, {recorder.saved} frames, {size}, {state}, {lost}"


_WAIT_S = 0.2
_say = partial(say, "ethercat-record")


def run(argv: Sequence[str] | None, signals: Signals) -> int:
    """Record; returns the exit code."""
    options = parse_options(argv)
    if options.until_eof:
        _stop_at_eof(signals)
    parts = Parts(
        options.path, size=options.rotate_size, seconds=options.rotate_seconds, overwrite=options.force
    )
    source = Source(options.address, options.sensors)
    try:
        with contextlib.closing(source):
            return _run(source, parts, options, signals)
    except UnreachableError as error:
        _say(f"{error.at(options.address)}, or use --wait")
    except RefusedError as error:
        _say(f"the server refused: {error}")
    except (RecordingError, ProtocolError) as error:
        _say(str(error))
    return 1


def _run(source: Source, parts: Parts, options: RecordOptions, signals: Signals) -> int:
    parts.check()
    first = _connect(source, options, signals)
    if first is None:
        _say("stopped before the server started; nothing was recorded")
        return 0
    recorder = Recorder(parts, f"ethercat-record {VERSION}", _notes(options, source))
    return _record(source, recorder, first, options, parts, signals)


def _connect(source: Source, options: RecordOptions, signals: Signals) -> Batch | None:
    """The first batch; None if it was stopped before."""
    waiting = False
    while True:
        try:
            return source.connect()
        except ConnectionFailedError:
            if not options.wait:
                raise
        if not waiting:
            _say(f"waiting for a server at {options.address}")
            waiting = True
        if signals.asked:
            return None
        time.sleep(_WAIT_S)


def _record(
    source: Source, recorder: Recorder, batch: Batch, options: RecordOptions, parts: Parts, signals: Signals
) -> int:
    began, reason = time.monotonic(), "asked to stop"
    with Progress(options.path.name, options.seconds) as progress:
        progress.say(f"recording {options.address} to {parts.made[0]}; Ctrl-C ends it")
        while True:
            recorder.put(batch)
            _report(batch, progress)
            if recorder.failed or signals.asked:
                break
            if options.seconds is not None and time.monotonic() - began >= options.seconds:
                reason = "time is up"
                break
            if not (source.connected or options.reconnect):
                reason = "the server ended"
                break
            progress.show(recorder, connected=source.connected)
            batch = source.receive()
        seconds = time.monotonic() - began
        source.close()
        recorder.stop(reason)
    if recorder.error is not None:
        _say(str(recorder.error))
    _say(_summary(recorder, parts, seconds))
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


def _summary(recorder: Recorder, parts: Parts, seconds: float) -> str:
    files = str(parts.made[0]) if len(parts.made) == 1 else f"{parts.made[0]} to {parts.made[-1].name}"
    frames = f"{recorder.saved} frames of {count(len(recorder.tally.sensors), 'sensor')}"
    losses = ", ".join(recorder.tally.losses()) or "nothing was lost"
    return f"{files}: {duration(seconds)}, {frames}, {data_size(recorder.bytes_written)}; {losses}"


def _notes(options: RecordOptions, source: Source) -> dict[str, str]:
    assert source.description is not None
    return {
        "format": FORMAT_VERSION,
        "recorder": f"ethercat-record {VERSION}",
        "server": str(options.address),
        "server_version": printable(source.description.get("version"), 40),
        "host": socket.gethostname(),
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **({"sensors": " ".join(map(str, options.sensors))} if options.sensors else {}),
    }
