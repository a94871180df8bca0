"""Recordings for tests, made without a server."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path

from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_writer import DiskFile
from bota_clients.recording.writer import RecordingWriter
from bota_ethercat import pdo
from bota_ethercat.framing import DataMessage
from bota_ethercat.text.json_text import JsonObject
from tests.descriptions import description, sensor_row

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_250_000
NOTHING: Mapping[str, str] = {}


def describe(*sensors: int, **settings: object) -> JsonObject:
    """A reply to `describe` with these sensors."""
    rows = [sensor_row(sensor, settings={"sinc_length": 64, **settings}) for sensor in sensors]
    return description(*rows, reply="describe", ok=True)


def frame(number: int, sensor: int = 0, flags: int = 0, size: int = 61, **values: float) -> DataMessage:
    """Frame `number` of a sensor; its force x is `number`."""
    data = pdo.encode(size, {"force.x": number, "temperature": 35.5, **values})
    moment = number * PERIOD_NS
    return DataMessage(number, START_NS + moment, moment, sensor, flags, 3, data)


def write(
    path: Path,
    items: Iterable[DataMessage | JsonObject],
    chunk: int = 100,
    end: Mapping[str, str] | None = NOTHING,
    **notes: str,
) -> None:
    """A recording of frames, descriptions and events, which are received with the frame before.

    With a chunk for so many frames. `end` are the notes at its end; None: it is cut off.
    """
    disk = DiskFile(path, overwrite=True)
    made, now_ns, frames = RecordingWriter(disk, "test", notes), START_NS, 0
    for item in items:
        if not isinstance(item, DataMessage):
            made.note((RecordedEvent if "event" in item else RecordedDescription)(now_ns, item))
            continue
        made.frame(item)
        now_ns, frames = item.stamp_ns, frames + 1
        if frames % chunk == 0:
            made.flush()
    if end is not None:
        made.finish(end)
    disk.close()


def record(
    path: Path,
    frames: Iterable[DataMessage],
    chunk: int = 100,
    sensors: tuple[int, ...] = (0,),
    **settings: object,
) -> None:
    """A whole recording of `frames` of these sensors, which have these settings."""
    write(path, chain([describe(*sensors, **settings)], frames), chunk)
