"""The log: one line per event on standard error, with priorities for journald, rate-limited.

A thread writes it, so that a stopped terminal (Ctrl-S) or an unread pipe blocks nothing else.
"""

from __future__ import annotations

import logging
import os
import select
import sys
import threading
import time
from queue import SimpleQueue
from typing import Final

from ethercat_server.process import realtime

MOST_LINES: Final = 1000  # lines that wait to be written; further ones are dropped and counted
_FLUSH_S: Final = 1.0  # longest time that the end of the process waits for what is still to be written


class QueuedHandler(logging.Handler):
    """Writes lines to the descriptor `fd`, without blocking the caller."""

    def __init__(self, fd: int) -> None:
        super().__init__()
        self._fd = fd
        self._waiting: SimpleQueue[bytes | threading.Event] = SimpleQueue()
        self._dropped = 0
        self._writer: threading.Thread | None = None

    def emit(self, record: logging.LogRecord) -> None:
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
                return  # its reader is gone


_MOST_AT_ONCE: Final = 5
_WINDOW_S: Final = 10.0
_MOST_KINDS: Final = 1000
# Levels of `logging` and their syslog priorities, as in sd-daemon(3).
_PRIORITIES: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7))


def set_up_logging() -> None:
    """Log to standard error, with priorities if journald reads it."""
    try:
        handler: logging.Handler = QueuedHandler(sys.stderr.fileno())
    except (AttributeError, OSError, ValueError):
        handler = logging.NullHandler()  # there is no standard error
    handler.setFormatter(OneLine(None if goes_to_journal() else "ethercat-server"))
    handler.addFilter(Repetitions())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def goes_to_journal() -> bool:
    """Whether standard error is the stream that systemd connected to the journal."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (AttributeError, OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class OneLine(logging.Formatter):
    """`PROGRAM: message`, with a traceback in the same line.

    Without a program for journald, which knows its name and reads the priority from `<N>`.
    """

    def __init__(self, program: str | None) -> None:
        super().__init__()
        self._program = program

    def format(self, record: logging.LogRecord) -> str:
        text = " | ".join(line.strip() for line in super().format(record).splitlines())
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        return f"{self._program}: {text}" if self._program else f"<{priority}>{text}"


class Repetitions(logging.Filter):
    """Rate limit: five lines of one kind in 10 s; the next one afterwards says how many were suppressed.

    journald limits rates too, but for the service as a whole: without this an unprivileged client could flood
    the log until the loss of a sensor is not logged.
    """

    def __init__(self) -> None:
        super().__init__()
        # Start of the interval and events in it, by message template and the record's `kind`.
        self._seen: dict[object, tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        now, key = time.monotonic(), (record.msg, getattr(record, "kind", ""))
        if len(self._seen) > _MOST_KINDS:
            self._seen.clear()
        began, count = self._seen.get(key, (now, 0))
        if now - began > _WINDOW_S:
            if count > _MOST_AT_ONCE:
                record.msg = f"{record.msg} ({count - _MOST_AT_ONCE} similar messages suppressed)"
            self._seen[key] = (now, 1)
            return True
        self._seen[key] = (began, count + 1)
        return count < _MOST_AT_ONCE
