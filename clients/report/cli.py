"""`ethercat-report`: reads or listens, examines, writes the page, says the verdict."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from clients.recording.errors import RecordingError
from clients.report import live, recorded
from clients.report.check import Level
from clients.report.errors import ReportError
from clients.report.examine import Examination, examine
from clients.report.options import ReportOptions, parse_options
from clients.report.page import as_json, render
from clients.report.subject import Subject
from clients.version import VERSION
from protocol.errors import ConnectionFailedError, ProtocolError, UnreachableError

EXIT_CODES = {Level.OK: 0, Level.NOT_POSSIBLE: 3, Level.ATTENTION: 4, Level.FAULT: 5}


def main(argv: Sequence[str] | None = None) -> int:
    """Make a report; returns the exit code."""
    options = parse_options(argv)
    try:
        examinations = [examine(each) for each in _subjects(options)]
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        page = render(examinations, made=now, program=f"ethercat-report {VERSION}", note=options.note)
        _write(options.output, page)
    except KeyboardInterrupt:
        return _fail("stopped: no report was written")
    except UnreachableError as error:
        return _fail(f"no server at {options.server}: {error}; start ethercat-server, or give its HOST:PORT")
    except ConnectionFailedError as error:
        return _fail(f"the server at {options.server} cannot be used: {error}")
    except (RecordingError, ProtocolError, ReportError) as error:
        return _fail(str(error))
    if options.json:
        print(as_json(examinations))
    else:
        _summary(examinations)
    print(f"ethercat-report: the report is in {options.output}", file=sys.stderr)
    return max((EXIT_CODES[each.verdict.level] for each in examinations), default=0)


def _subjects(options: ReportOptions) -> list[Subject]:
    if options.recording is not None:
        return recorded.subjects(options.recording, options.sensor, options.imu_units)
    with _progress(options.seconds) as progress:
        return live.subjects(options.server, options.seconds, options.sensor, options.imu_units, progress)


class _progress:  # noqa: N801
    """Says on a terminal how much of the listening is left, on one line that is cleared at the end."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._shown = seconds, -1
        self._terminal = sys.stderr.isatty()

    def __enter__(self) -> Callable[[float], None]:
        return self._show

    def __exit__(self, *_: object) -> None:
        if self._terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _show(self, passed: float) -> None:
        if self._terminal and int(passed) != self._shown:
            self._shown = int(passed)
            left = f"listening, {self._seconds - passed:.0f} s left"
            print(f"\r\x1b[K{left}", end="", file=sys.stderr, flush=True)


def _write(path: Path, page: str) -> None:
    """Whole or not at all: a report that was there stays until the new one is complete."""
    made: str | None = None
    try:
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=path.parent, prefix=f".{path.name}.", delete=False
        ) as file:
            made = file.name
            file.write(page)
        mask = os.umask(0)
        os.umask(mask)
        Path(made).chmod(0o666 & ~mask)
        Path(made).replace(path)
        made = None
    except OSError as error:
        raise ReportError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        if made is not None:
            with contextlib.suppress(OSError):
                Path(made).unlink()


def _summary(examinations: Sequence[Examination]) -> None:
    for each in examinations:
        subject = each.subject
        print(f"Sensor {subject.place} ({subject.name}, serial {subject.serial}): {each.verdict.headline}. "
              f"{each.verdict.sentence}")  # fmt: skip
        for check in each.checks:
            if check.level >= Level.NOT_POSSIBLE:
                print(f"  {check.level.word}: {check.name}: {check.found}")
                if check.remedy:
                    print(f"    {check.remedy}")


def _fail(sentence: str) -> int:
    print(f"ethercat-report: {sentence}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
