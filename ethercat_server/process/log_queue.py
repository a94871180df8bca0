"""Writes the log in a thread: a stopped terminal (Ctrl-S) or a pipe that nobody reads blocks nothing else."""

from __future__ import annotations

import logging
import os
import select
import threading
from queue import SimpleQueue
from typing import Final

from ethercat_server.process import realtime

MOST_LINES: Final = 1000
"""Lines that wait to be written; further ones are dropped and counted."""
_FLUSH_S: Final = 1.0
"""Longest time that the end of the process waits for what is still to be written."""


class QueuedHandler(logging.Handler):
    """Writes lines to the descriptor `fd`. Whoever logs never waits for it."""

    def __init__(self, fd: int) -> None:
        super().__init__()
        self._fd = fd
        self._waiting: SimpleQueue[bytes | threading.Event] = SimpleQueue()
        self._dropped = 0
        self._writer: threading.Thread | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Have the line of an event written."""
        if self._waiting.qsize() >= MOST_LINES:
            self._dropped += 1
            return
        try:
            self._waiting.put(self._line(record))
        except Exception:  # noqa: BLE001 - as every handler of `logging` does
            self.handleError(record)
        if self._writer is None:
            self._writer = threading.Thread(target=self._run, name="log", daemon=True)
            self._writer.start()

    def flush(self) -> None:
        """Wait until everything is written, or for a second."""
        if self._writer is not None:
            written = threading.Event()
            self._waiting.put(written)
            written.wait(_FLUSH_S)

    def _line(self, record: logging.LogRecord) -> bytes:
        return self.format(record).encode("utf-8", "backslashreplace") + b"\n"

    def _run(self) -> None:
        realtime.leave()
        said = 0
        while True:
            item = self._waiting.get()
            if isinstance(item, bytes):
                self._write(item)
            dropped = self._dropped
            if dropped > said and self._waiting.empty():
                text = f"{dropped - said} log messages dropped: standard error was blocked"
                self._write(self._line(logging.makeLogRecord({"levelno": logging.WARNING, "msg": text})))
                said = dropped
            if isinstance(item, threading.Event):
                item.set()

    def _write(self, line: bytes) -> None:
        while line:
            try:
                line = line[os.write(self._fd, line) :]
            except BlockingIOError:  # another process made it non-blocking
                poller = select.poll()
                poller.register(self._fd, select.POLLOUT)
                poller.poll()
            except OSError:
                return  # nobody is there to read it
