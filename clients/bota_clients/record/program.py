"""What `ethercat-record` does: connects, records until it is stopped, reports what it recorded and lost.

Progress is a line on standard error, if that is a terminal.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable
from functools import partial

from rich.console import Console
from rich.text import Text

from bota_clients.errors import RecordingError
from bota_clients.numbers import duration
from bota_clients.program import Signals, say
from bota_clients.record.recorder import NAME, Batch, Recorder, RecordingClient, notes, record
from bota_clients.recording.file_format import RecordedEvent
from bota_ethercat.control import event_sentence
from bota_ethercat.errors import RefusedError
from bota_ethercat.program.new_file import refuse_existing
from bota_ethercat.text.untrusted import printable

_say = partial(say, "ethercat-record")


def run(options: argparse.Namespace, signals: Signals) -> int:
    with contextlib.closing(RecordingClient(options.address, options.sensors)) as source:
        try:
            refuse_existing(options.path, force=options.force)
            source.connect()
        except RefusedError as error:
            raise RecordingError(f"the server refused: {error}") from None
        return _record(source, options, signals)


def _record(source: RecordingClient, options: argparse.Namespace, signals: Signals) -> int:
    console = Console(stderr=True, highlight=False)
    show = partial(console.print, markup=False, soft_wrap=True)
    began = time.monotonic()

    recorder = Recorder(options.path, NAME, notes(source), overwrite=options.force)

    def until(batch: Batch) -> str | None:
        _report(batch, show)
        connected, passed_s = source.session.connected, time.monotonic() - began
        of = "" if options.seconds is None else f" of {duration(options.seconds)}"
        state = "" if connected else "no server, reconnecting; "
        status.update(Text(f"{state}{duration(passed_s)}{of}, {recorder.summary}"))
        if signals.asked:
            return "asked to stop"
        if options.seconds is not None and passed_s >= options.seconds:
            return "time is up"
        return None if connected or options.reconnect else "the server ended"

    with recorder, console.status("") as status:
        show(f"recording {options.address} to {options.path}; Ctrl-C ends it")
        record(source, recorder, until)
    if recorder.error is not None:
        _say(str(recorder.error))
    _say(f"{options.path}: {duration(time.monotonic() - began)}, {recorder.summary}")
    return int(recorder.error is not None)


def _report(batch: Batch, show: Callable[[str], None]) -> None:
    for item in batch:
        if isinstance(item, RecordedEvent):
            words = item.event.get("message") or item.event.get("reason") or ""
            if not item.by_recorder:
                show(event_sentence(item.event))
            elif item.name != "connected" or words:
                show(printable(f"{item.name}{': ' if words else ''}{words}", 300))
