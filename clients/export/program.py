"""What `ethercat-export` does: reads the recording, writes the table, says what it left out."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Final

from clients.errors import RecordingError
from clients.export.options import ExportOptions
from clients.export.table import Table
from clients.numbers import count
from clients.program import say
from clients.recording.reader import open_recording
from protocol.errors import ProtocolError
from protocol.program.new_file import NewFile

_say = partial(say, "ethercat-export")
_SHOW_EVERY_S: Final = 0.5
_BETWEEN: Final = 1000


def run(options: ExportOptions) -> int:
    """Export; returns the exit code."""
    try:
        return _export(options)
    except (RecordingError, ProtocolError) as error:
        _say(str(error))
        return 1


def _export(options: ExportOptions) -> int:
    table = Table(options.imu_units, everything=options.all)
    with open_recording(options.recording) as recording:
        there = {sensor.sensor: sensor.frames for sensor in recording.sensors if sensor.frames}
        if not there or options.sensor not in {None, *there}:
            which = "" if options.sensor is None else f" of sensor {options.sensor}"
            raise RecordingError(f"{options.recording} has no samples{which}")
        if recording.cut_off is not None:
            _say(f"{options.recording} was cut off ({recording.cut_off}): the intact part is exported")
        total = sum(there.values()) if options.sensor is None else there[options.sensor]
        with NewFile(options.output, force=options.force) as file:
            for line in _shown(table.lines(recording.frames(options.sensor)), total):
                file.write(line)
            file.finish()
    left = f"; {count(table.left_out, 'frame')} without a new sample left out" if table.left_out else ""
    _say(f"{options.output}: {count(table.written, 'sample')}{left}")
    return 0


def _shown(lines: Iterable[str], total: int) -> Iterator[str]:
    """The same lines, with the progress on a terminal."""
    terminal, due = sys.stderr.isatty(), time.monotonic() + _SHOW_EVERY_S
    for number, line in enumerate(lines):
        yield line
        if terminal and number % _BETWEEN == 0 and time.monotonic() >= due:
            due += _SHOW_EVERY_S
            sys.stderr.write(f"\r\x1b[K{100 * number // total} %")
            sys.stderr.flush()
    if terminal:
        sys.stderr.write("\r\x1b[K")
