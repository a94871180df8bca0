"""What `ethercat-export RECORDING --mcap OUT` does: all messages of a recording in a complete file.

Readers other than `recording.reader` open no file without the index at its end, which a recorder that was
killed does not write.
"""

from __future__ import annotations

import argparse

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.export.cli import PROGRAM
from bota_clients.numbers import count
from bota_clients.recording.mcap_writer import whole_file
from bota_clients.recording.reader import Recording
from bota_clients.recording.writer import RecordingWriter
from bota_ethercat.program.version import VERSION


def write(options: argparse.Namespace, recording: Recording) -> str:
    """Frames, descriptions and events, in file order, into a file; says how many frames. RecordingError.

    A recording that was cut off has no notes at its end here either; `repaired` at its start says why.
    """
    sensor, notes = options.sensor, dict(recording.metadata)
    if sensor is not None:
        if sensor not in {each.sensor for each in recording.sensors if each.frames}:
            raise RecordingError(f"{recording.path} has no samples of sensor {sensor}")
        notes["sensors"] = str(sensor)
    if recording.cut_off is not None:
        notes["repaired"] = recording.cut_off
    with whole_file(options.output, force=options.force) as disk:
        writer = RecordingWriter(disk, f"{PROGRAM} {VERSION}", notes)
        for item in recording.tables(sensor):
            if isinstance(item, np.ndarray):
                writer.table(item)
            else:
                writer.note(item)
            disk.flush()
        writer.finish(recording.end)
    return count(writer.frames, "frame")
