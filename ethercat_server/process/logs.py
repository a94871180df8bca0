"""The log: one line per event on standard error, with priorities for journald, rate-limited."""

from __future__ import annotations

import logging
import os
import sys
import time
from typing import Final

from ethercat_server.process.log_queue import QueuedHandler

_MOST_AT_ONCE: Final = 5
_WINDOW_S: Final = 10.0
_MOST_KINDS: Final = 1000
_PRIORITIES: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7))
"""Levels of `logging` and their syslog priorities, as in sd-daemon(3)."""


def set_up_logging() -> None:
    """Log to standard error, with priorities if journald reads it."""
    try:
        handler: logging.Handler = QueuedHandler(sys.stderr.fileno())
    except (AttributeError, OSError, ValueError):
        handler = logging.NullHandler()  # there is no standard error
    handler.setFormatter(JournalFormatter() if goes_to_journal() else PlainFormatter())
    handler.addFilter(Repetitions())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def goes_to_journal() -> bool:
    """Whether standard error is the stream that systemd connected to the journal."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (AttributeError, OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class PlainFormatter(logging.Formatter):
    """`ethercat-server: message`, with a traceback in the same line."""

    prefix = "ethercat-server: "

    def format(self, record: logging.LogRecord) -> str:
        """The line of one event."""
        text = super().format(record)
        return self.prefix + " | ".join(line.strip() for line in text.splitlines())


class JournalFormatter(PlainFormatter):
    """The same for journald, which knows the program's name and reads the priority from `<N>`."""

    prefix = ""

    def format(self, record: logging.LogRecord) -> str:
        """The line of one event."""
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{super().format(record)}"


class Repetitions(logging.Filter):
    """Rate limit: five lines of one kind in 10 s; the next one afterwards says how many were suppressed.

    journald limits rates too, but for the service as a whole: without this an unprivileged client could flood
    the log until the loss of a sensor is not logged.
    """

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[object, tuple[float, int]] = {}
        """Start of the interval and events in it, by message template and the record's `kind`."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether `record` is to be logged."""
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
