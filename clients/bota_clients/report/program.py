"""Reads or listens, examines, writes the page. Everything heavy is imported here; `cli.py` prints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from bota_clients.errors import RecordingError, ReportError
from bota_clients.report import subjects
from bota_clients.report.checks import Examination, examine
from bota_clients.report.options import ReportOptions
from bota_clients.report.page import as_json, render
from bota_clients.report.series import Subject
from bota_ethercat.errors import ConnectionFailedError, ProtocolError, UnreachableError
from bota_ethercat.health.verdict import Level
from bota_ethercat.program.new_file import NewFile
from bota_ethercat.program.version import VERSION

EXIT_CODES = {Level.GOOD: 0, Level.NOT_POSSIBLE: 0, Level.LOOK: 0, Level.TROUBLE: 1}


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a report."""

    words: str
    """For the standard output."""
    exit_code: int


def make(options: ReportOptions, progress: Callable[[float], None]) -> Outcome:
    """Make the report; ReportError. `progress` is called with the time listened so far, s."""
    try:
        with NewFile(options.output, force=options.force) as file:
            return _make(options, progress, file)
    except UnreachableError as error:
        raise ReportError(f"{error.at(options.server)}, or give its HOST:PORT") from None
    except ConnectionFailedError as error:
        raise ReportError(f"the server at {options.server} cannot be used: {error}") from None
    except (RecordingError, ProtocolError) as error:
        raise ReportError(str(error)) from None


def _make(options: ReportOptions, progress: Callable[[float], None], file: NewFile) -> Outcome:
    examinations = [examine(each) for each in _subjects(options, progress)]
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    page = render(examinations, made=now, program=f"ethercat-report {VERSION}", note=options.note)
    file.write(page)
    file.finish()
    words = as_json(examinations) if options.json else _summary(examinations)
    return Outcome(words, max(EXIT_CODES[each.verdict.level] for each in examinations))


def _subjects(options: ReportOptions, progress: Callable[[float], None]) -> list[Subject]:
    if options.recording is not None:
        return subjects.of_recording(options.recording, options.sensor, options.imu_units)
    assert options.server is not None
    return subjects.of_server(options.server, options.seconds, options.sensor, options.imu_units, progress)


def _summary(examinations: Sequence[Examination]) -> str:
    lines = []
    for each in examinations:
        subject = each.subject
        who = f"Sensor {subject.position} ({subject.who})"
        lines.append(f"{who}: {each.verdict.headline}. {each.verdict.sentence}")
        lines += [f"  {remark}" for remark in subject.remarks]
        for check in each.checks:
            if check.level >= Level.NOT_POSSIBLE:
                lines.append(f"  {check.level.words}: {check.name}: {check.found}")
                lines += [f"    {check.remedy}"] if check.remedy else []
    return "\n".join(lines)
