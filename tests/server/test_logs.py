"""The form of log lines, and that repetitions are summed up."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from bota_ethercat.errors import ConnectionFailedError
from ethercat_server.process import logs
from ethercat_server.process.logs import (
    MOST_LINES,
    OneLine,
    QueuedHandler,
    Repetitions,
    goes_to_journal,
)
from tests.server.running import ATTEMPTS, Server, on_a_bus


def record(message: str, *arguments: object, level: int = logging.WARNING) -> logging.LogRecord:
    return logging.LogRecord("x", level, __file__, 1, message, arguments, None)


def test_an_event_is_one_line_even_with_a_traceback() -> None:
    try:
        raise ValueError("two\nlines")
    except ValueError:
        event = record("failed")
        event.exc_info = cast("tuple[type[BaseException], BaseException, None]", sys.exc_info())
    text = OneLine("ethercat-server").format(event)
    assert text.startswith("ethercat-server: failed | Traceback")
    assert "\n" not in text
    assert "ValueError: two" in text


@pytest.mark.parametrize(
    ("level", "prefix"),
    [(logging.ERROR, "<3>"), (logging.WARNING, "<4>"), (logging.INFO, "<6>"), (logging.DEBUG, "<7>")],
)
def test_journald_gets_the_priority(level: int, prefix: str) -> None:
    assert OneLine(None).format(record("a %d", 1, level=level)) == f"{prefix}a 1"


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


# -- a terminal or pipe that takes nothing


class Pipe:
    """A pipe that nobody reads, and that is full."""

    def __init__(self) -> None:
        self.reading, self.writing = os.pipe()
        fcntl.fcntl(self.writing, fcntl.F_SETPIPE_SZ, 4096)
        os.set_blocking(self.writing, False)
        self.filled = 0
        with contextlib.suppress(BlockingIOError):
            while True:
                self.filled += os.write(self.writing, b"." * 1024)
        os.set_blocking(self.writing, True)

    def drain(self, end: bytes) -> list[str]:
        """What was written to it, up to this end."""
        data = b""
        while not data.endswith(end):
            data += os.read(self.reading, 65536)
        return data[self.filled :].decode().splitlines()

    def close(self) -> None:
        os.close(self.reading)
        os.close(self.writing)


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    with contextlib.closing(Pipe()) as found:
        yield found


def test_who_logs_does_not_wait_but_learns_of_drops(pipe: Pipe, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real pipe, because only that blocks. The first line may be with the writer already."""
    monkeypatch.setattr(logs, "_FLUSH_S", 0.01)
    handler = QueuedHandler(pipe.writing)
    handler.setFormatter(OneLine("ethercat-server"))
    for number in range(MOST_LINES + 100):
        handler.handle(record("event %d", number))
    handler.flush()  # returns all the same
    lines = pipe.drain(b"blocked\n")
    count = len(lines) - 1
    assert lines[:-1] == [f"ethercat-server: event {number}" for number in range(count)], "the first ones"
    assert lines[-1] == (
        f"ethercat-server: {MOST_LINES + 100 - count} log messages dropped: standard error was blocked"
    )
    assert MOST_LINES <= count <= MOST_LINES + 1
    handler.handle(record("after"))
    assert pipe.drain(b"after\n") == [], "less than what had filled it"
    handler.flush()


def test_everything_is_written_before_the_end() -> None:
    """Of a real process, in one that ends at once."""
    program = "import logging; from ethercat_server.process.logs import set_up_logging; set_up_logging()\n"
    program += "for number in range(500): logging.info(str(number))"
    environment = {name: value for name, value in os.environ.items() if name != "JOURNAL_STREAM"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, env=environment)
    assert done.stderr.count(b"\n") == 500


def test_without_standard_error_nothing_is_written_anywhere(tmp_path: Path) -> None:
    """Its descriptor may be another file's by then: in a process of its own."""
    other = tmp_path / "other"
    program = "import logging, os, sys; from ethercat_server.process.logs import set_up_logging\n"
    program += "os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT); set_up_logging(); logging.info('x')"
    done = subprocess.run(
        ["sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-c", program, str(other)],
        check=False, cwd=Path(__file__).parent.parent.parent,
    )  # fmt: skip
    assert done.returncode == 0
    assert other.read_text() == ""


@on_a_bus
def test_the_server_streams_and_ends_while_nobody_reads_its_log(pipe: Pipe) -> None:
    """What blocks is the kernel's pipe, so it is a real server; it used to stop at its first line."""
    into_pipe = ("sh", "-c", f'exec "$@" 2>/proc/{os.getpid()}/fd/{pipe.writing}', "sh")
    for _ in range(ATTEMPTS):  # on a busy machine the sensor may be starved
        with contextlib.closing(Server("virtual", under=into_pipe)) as running:
            while running.process.poll() is None:
                try:
                    with running.connect() as client:
                        assert client.ask("subscribe")["ok"]
                        client.fresh(100)
                        assert client.ask("shutdown")["ok"]
                except ConnectionFailedError:
                    time.sleep(0.02)
                    continue
                assert running.wait() == 0
                return
    pytest.fail("it did not start")
