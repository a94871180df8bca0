"""Recordings for tests, made without a server."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from bota_clients.recording.writer import DiskFile, RecordingWriter
from bota_ethercat import pdo
from bota_ethercat.framing import DataMessage
from bota_ethercat.text.json_text import JsonObject
from tests.descriptions import description, sensor_row

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_250_000


def describe(*sensors: int, **settings: object) -> JsonObject:
    """A reply to `describe` with these sensors."""
    rows = [sensor_row(sensor, settings={"sinc_length": 64, **settings}) for sensor in sensors]
    return description(*rows, reply="describe", ok=True)


def frame(number: int, sensor: int = 0, flags: int = 0, size: int = 61, **values: float) -> DataMessage:
    """Frame `number` of a sensor; its force x is `number`."""
    data = pdo.encode(size, {"force.x": number, "temperature": 35.5, **values})
    moment = number * PERIOD_NS
    return DataMessage(number, START_NS + moment, moment, sensor, flags, 3, data)


def writer(path: Path, **notes: str) -> RecordingWriter:
    """A new recording at `path`."""
    disk = DiskFile(path, overwrite=True)
    return RecordingWriter(disk, "test", notes)


def record(
    path: Path,
    frames: Iterable[DataMessage],
    chunk: int = 100,
    sensors: tuple[int, ...] = (0,),
    **settings: object,
) -> list[DataMessage]:
    """A whole recording of `frames`, with a chunk for so many of them; returns them."""
    made = writer(path)
    made.describe(START_NS, describe(*sensors, **settings))
    written = []
    for count, item in enumerate(frames, 1):
        written.append(item)
        made.frame(item)
        if count % chunk == 0:
            made.flush()
    made.finish({})
    return written
