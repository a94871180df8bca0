"""`ethercat-report`: command line and output. Reads a recording, examines, writes the page."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bota_clients.arguments import add_force
from bota_clients.program import interrupt_on_signals, say, start
from bota_clients.recording.asked import Asked, add_reading
from bota_ethercat.health.limits import Level
from bota_ethercat.program.arguments import Parser
from bota_ethercat.program.new_file import NewFile
from bota_ethercat.program.output import discard_output, ends_with_its_reader
from bota_ethercat.program.server_choice import is_address
from bota_ethercat.program.version import VERSION

if TYPE_CHECKING:
    from bota_clients.report.checks import Examination

_PROGRAM: Final = "ethercat-report"


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; argparse exits with 2 if it is wrong."""
    made = Parser(
        _PROGRAM,
        "Writes a one-page sensor health report (HTML) from a recording.",
        "exit code: 0 good, worth a look or not conclusive, 1 trouble, or no report was made, 2 wrong usage",
    )
    add = made.add_argument
    add("recording", type=Path, metavar="FILE.mcap", help="a recording of ethercat-record")
    add("-o", "--output", type=Path, metavar="REPORT.html",
        help="where to write the page (default: beside the recording)")  # fmt: skip
    add_force(made)
    add_reading(made)
    add("--note", default="", metavar="TEXT", help="a remark for the head of the page")
    add("--json", action="store_true", help="print the checks as JSON")
    options = made.parse_args(argv)
    recording = options.recording
    if is_address(str(recording)) and not recording.exists():
        made.error(f"{recording} is a server's address: record its stream first, with ethercat-record")
    options.output = options.output or recording.with_suffix(".html")
    if options.output.absolute() == recording.absolute():
        made.error("the report would overwrite the recording: give another name with -o")
    return options


@ends_with_its_reader
def main(argv: Sequence[str] | None = None) -> int:
    return start(_PROGRAM, "report.cli", parse_options(argv))


def run(options: argparse.Namespace) -> int:
    from bota_clients.report import checks, page, series  # noqa: PLC0415 - needs the extra

    interrupt_on_signals()
    with NewFile(options.output, force=options.force) as file:
        found = series.of_recording(options.recording, options.imu_units, Asked.of(options))
        examinations = [checks.Examination(each) for each in found]
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        file.write(page.render(examinations, made=now, program=f"{_PROGRAM} {VERSION}", note=options.note))
        file.finish()
    try:
        print(
            page.as_json(examinations) if options.json else "\n".join(map(_summary, examinations)), flush=True
        )
    except BrokenPipeError:
        discard_output()  # the report is in its file
    say(_PROGRAM, f"the report is in {options.output}")
    return int(any(each.level is Level.TROUBLE for each in examinations))


def _summary(examination: Examination) -> str:
    subject = examination.subject
    who = f"Sensor {subject.info.sensor} ({subject.who})"
    lines = [f"{who}: {examination.headline}. {examination.sentence}"]
    lines += [f"  {remark}" for remark in subject.remarks]
    for check in examination.checks:
        if check.level >= Level.NOT_POSSIBLE:
            lines.append(f"  {check.level.words}: {check.name}: {check.found}")
            lines += [f"    {check.remedy}"] if check.remedy else []
    return "\n".join(lines)
