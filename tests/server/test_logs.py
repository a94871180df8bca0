"""The form of log lines, and that repetitions are summed up."""

from __future__ import annotations

import logging
import os
import sys
from types import SimpleNamespace
from typing import cast

import pytest

from ethercat_server.process import logs
from ethercat_server.process.logs import JournalFormatter, PlainFormatter, Repetitions, goes_to_journal


def record(message: str, *arguments: object, level: int = logging.WARNING) -> logging.LogRecord:
    return logging.LogRecord("x", level, __file__, 1, message, arguments, None)


def test_an_event_is_one_line_even_with_a_traceback() -> None:
    try:
        raise ValueError("two\nlines")
    except ValueError:
        event = record("failed")
        event.exc_info = cast("tuple[type[BaseException], BaseException, None]", sys.exc_info())
    text = PlainFormatter().format(event)
    assert text.startswith("ethercat-server: failed | Traceback")
    assert "\n" not in text
    assert "ValueError: two" in text


@pytest.mark.parametrize(
    ("level", "prefix"),
    [(logging.ERROR, "<3>"), (logging.WARNING, "<4>"), (logging.INFO, "<6>"), (logging.DEBUG, "<7>")],
)
def test_journald_gets_the_priority(level: int, prefix: str) -> None:
    assert JournalFormatter().format(record("a %d", 1, level=level)) == f"{prefix}a 1"


def test_the_journal_is_recognised_by_its_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.delenv("JOURNAL_STREAM", raising=False)
        assert not goes_to_journal()
        status = os.fstat(writing)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert goes_to_journal()
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
        assert not goes_to_journal()
    os.close(reading)


def test_repetitions_are_counted_and_told_with_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(logs, "time", SimpleNamespace(monotonic=lambda: now))
    repetitions = Repetitions()
    passed = [repetitions.filter(record("denied %d", number)) for number in range(20)]
    assert passed.count(True) == 5
    assert passed[:5] == [True] * 5
    assert repetitions.filter(record("another")), "others are not held back by it"
    now += 11
    late = record("denied %d", 20)
    assert repetitions.filter(late)
    assert late.getMessage() == "denied 20 (15 similar messages suppressed)"
    other = record("denied %d", 99)
    other.kind = "another user"
    assert repetitions.filter(other), "what one user does hides nothing of another"
    now += 11
    alone = record("denied %d", 21)
    assert repetitions.filter(alone)
    assert alone.getMessage() == "denied 21"
