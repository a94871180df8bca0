"""The log: one line an event on standard error, with priorities for journald, repetitions summed up."""

from __future__ import annotations

import logging
import os
import sys
import time
from typing import Final

_MOST_AT_ONCE: Final = 5
_WINDOW_S: Final = 10.0
_MOST_KINDS: Final = 1000
_PRIORITIES: Final = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7))
"""Levels of `logging` and the ones of syslog that they are, as in sd-daemon(3)."""


def set_up_logging() -> None:
    """Log to standard error; in journald's own form if that is where it goes."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JournalFormatter() if goes_to_journal() else PlainFormatter())
    handler.addFilter(Repetitions())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def goes_to_journal() -> bool:
    """Whether standard error is the stream that systemd connected to the journal."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class PlainFormatter(logging.Formatter):
    """`ethercat-server: message`, a traceback folded into the same line."""

    prefix = "ethercat-server: "

    def format(self, record: logging.LogRecord) -> str:
        """The line of one event."""
        text = super().format(record)
        return self.prefix + " | ".join(line.strip() for line in text.splitlines())


class JournalFormatter(PlainFormatter):
    """The same for journald, which knows the program's name and takes the priority from `<N>`."""

    prefix = ""

    def format(self, record: logging.LogRecord) -> str:
        """The line of one event."""
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        return f"<{priority}>{super().format(record)}"


class Repetitions(logging.Filter):
    """Lets an event through a few times in a while; the next one later says how many were left out."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[object, tuple[float, int]] = {}
        """Start of the window and events in it, by the message's template and the `kind` it was given."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether `record` is to be logged."""
        now, key = time.monotonic(), (record.msg, getattr(record, "kind", ""))
        if len(self._seen) > _MOST_KINDS:
            self._seen.clear()
        began, count = self._seen.get(key, (now, 0))
        if now - began > _WINDOW_S:
            if count > _MOST_AT_ONCE:
                record.msg = f"{record.msg} (and {count - _MOST_AT_ONCE} more like it before)"
            self._seen[key] = (now, 1)
            return True
        self._seen[key] = (began, count + 1)
        return count < _MOST_AT_ONCE
