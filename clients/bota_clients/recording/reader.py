"""Reads a recording: the sensors, their settings over time, all frames and events.

    with open_recording(Path("run.mcap")) as recording:
        for frame in recording.frames(sensor=0):
            ...

A recording that was cut off (a killed recorder, a full disk, a power failure) is read up to its last complete
chunk; `cut_off` says so. `columns.py` gives NumPy arrays.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from bota_clients.errors import RecordingError
from bota_clients.recording import file_format
from bota_clients.recording.columns import Columns, Table, joined, table_of
from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_file import CHANNEL, McapFile, Rows, message_in
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce, Timeline

_MAX_NOTES: Final = 1_000_000  # descriptions and events
_BATCH: Final = 4096  # frames
_NOTE: Final = file_format.MAX_SENSOR + 1
REWRITTEN: Final = "has no notes of ethercat-record: another program wrote it"
_LONGEST_CHOICE: Final = 1024  # characters of the list of chosen positions


class Since(NamedTuple):
    """What was in force from a time on."""

    stamp_ns: int
    in_force: InForce

    @property
    def info(self) -> SensorInfo:
        return self.in_force.info


class RecordedSensor(NamedTuple):
    """A sensor of the recording."""

    sensor: int  # position on the bus, from 0
    info: SensorInfo  # as first described
    changes: tuple[Since, ...]  # all that was in force, oldest first; empty if it was never described
    frames: int  # number of its frames in the recording

    @property
    def history(self) -> tuple[Since, ...]:
        """By identity and settings, each as it was known last."""
        found: list[Since] = []
        for each in self.changes:
            same = found and found[-1].info
            if same and (same.identity, same.settings) == (each.info.identity, each.info.settings):
                found[-1] = Since(found[-1].stamp_ns, each.in_force)
            else:
                found.append(each)
        return tuple(found)

    @property
    def offsets(self) -> tuple[Since, ...]:
        """By what the sensor itself adds to every sample (object 0x8000)."""
        firsts = (next(same) for _, same in itertools.groupby(self.changes, lambda each: each.info.offset))
        return tuple(firsts)


def follow(timeline: Timeline, note: RecordedDescription | RecordedEvent) -> list[InForce]:
    """Feed the next description or event of a file; what it changed."""
    if isinstance(note, RecordedDescription):
        return timeline.describe(note.reply)
    if note.by_recorder:  # the description of a new connection follows
        return timeline.connected({}) if note.name == "connected" else []
    return timeline.event(note.event)


class Recording(McapFile):
    """An open recording. Use it as a context manager, or `close` it.

    Attributes:
        path: its path.
        cut_off: None if the recording is complete, else a clause that says how it ends.
        metadata: what the recorder wrote at the start, by name (docs/recording.md).
        is_rewritten: another program has written the frames again, and left that out.
        chosen: positions given with --sensor; empty for all.
        end: what the recorder wrote at the end, None if it was cut off.
        sensors: the sensors that the server described or that have frames, by position.
        events: every event, oldest first.
    """

    def _open(self) -> None:
        super()._open()
        found = self.notes.get(file_format.METADATA)
        self.is_rewritten = found is None and any(
            file_format.sensor_of_topic(topic) is not None for topic in self.topics.values()
        )
        if self.is_rewritten:
            found = {"format": file_format.FORMAT_VERSION}
        if found is None:
            raise RecordingError(f"{self.path} is an MCAP file, but ethercat-record did not write it")
        if found.get("format") != file_format.FORMAT_VERSION:
            raise RecordingError(
                f"{self.path} has format {found.get('format', '?')[:20]!r} and this program reads "
                f"{file_format.FORMAT_VERSION}: use the version that wrote it"
            )
        self.metadata: Mapping[str, str] = found
        chosen = found.get("sensors", "")[:_LONGEST_CHOICE].split()
        self.chosen = {int(position) for position in chosen if position.isascii() and position.isdecimal()}
        self.end: Mapping[str, str] | None = self.notes.get(file_format.END_METADATA)
        counts, self._noted, self._sensor_of = Counter[int](), set[int](), dict[int, int]()
        for number, topic in self.topics.items():
            if (sensor := file_format.sensor_of_topic(topic)) is not None:
                self._sensor_of[number] = sensor
                counts[sensor] += self.counts[number]
            elif topic in (file_format.DESCRIPTION_TOPIC, file_format.EVENTS_TOPIC):
                self._noted.add(number)
        self.frame_count = counts.total()
        self.events: list[RecordedEvent] = []
        timeline, changes = Timeline(), defaultdict[int, list[Since]](list)
        for taken, note in enumerate(self._parts(set())):
            if taken == _MAX_NOTES:
                raise RecordingError(f"{self.path} has more than {_MAX_NOTES} events")
            assert isinstance(note, RecordedDescription | RecordedEvent)
            for now in follow(timeline, note):
                changes[now.sensor].append(Since(note.stamp_ns, now))
            if isinstance(note, RecordedEvent):
                self.events.append(note)
        self.sensors: tuple[RecordedSensor, ...] = tuple(
            RecordedSensor(
                position,
                changes[position][0].info if position in changes else SensorInfo(position),
                tuple(changes.get(position, ())),
                counts[position],
            )
            for position in sorted(changes.keys() | counts.keys())
        )

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this position, or of all, in the order in which they came.

        RecordingError at the first corrupt part.
        """
        return (each for each in self.everything(sensor) if isinstance(each, DataMessage))

    def everything(
        self, sensor: int | None = None
    ) -> Iterator[DataMessage | RecordedDescription | RecordedEvent]:
        """Descriptions, events and the frames of the sensor at this position, or of all, as they came."""
        for part in self._parts(self._channels(sensor)):
            if isinstance(part, RecordedDescription | RecordedEvent):
                yield part
            else:
                for row, position in zip(*part, strict=True):
                    yield file_format.unpack_frame(message_in(row)[2], int(position))

    def tables(self, sensor: int | None = None) -> Iterator[Table | RecordedDescription | RecordedEvent]:
        """As `everything`, with the frames as arrays of a few thousand, which descriptions and events end."""
        held, sensors, count = list[Rows](), list[npt.NDArray[Any]](), 0
        for part in itertools.chain(self._parts(self._channels(sensor)), [None]):
            if part is None or isinstance(part, RecordedDescription | RecordedEvent):
                if count:
                    yield table_of(held, np.concatenate(sensors))
                held, sensors, count = [], [], 0
                if part is not None:
                    yield part
                continue
            rows, of = part
            while count + len(rows) >= _BATCH:
                left = _BATCH - count
                yield table_of([*held, rows[:left]], np.concatenate([*sensors, of[:left]]))
                held, sensors, count, rows, of = [], [], 0, rows[left:], of[left:]
            held, sensors, count = [*held, rows.copy()], [*sensors, of], count + len(rows)

    def batches(self, sensor: int, imu_units: ImuUnits = ImuUnits.G_DPS) -> Iterator[tuple[InForce, Columns]]:
        """Frames of the sensor at this position, a few thousand at once, with what was in force."""
        timeline, known = Timeline(), [each for each in self.sensors if each.sensor == sensor]
        in_force = timeline[sensor]
        if known and known[0].changes:  # in force before it was told
            in_force = known[0].changes[0].in_force
        for item in self.tables(sensor):
            if isinstance(item, np.ndarray):
                yield in_force, Columns.of(item, imu_units)
                continue
            for now in follow(timeline, item):
                in_force = now if now.sensor == sensor else in_force

    def columns(self, sensor: int, imu_units: ImuUnits = ImuUnits.G_DPS) -> Columns:
        """All frames of the sensor at this position as arrays, which must fit into memory."""
        found, count = Columns.empty(sum(each.frames for each in self.sensors if each.sensor == sensor)), 0
        for table in self.tables(sensor):
            if isinstance(table, np.ndarray):
                if count + len(table) > len(found):  # the index of the file is wrong
                    found = joined([found, Columns.empty(count + len(table))])
                found.where(slice(count, count + len(table))).fill(table, imu_units)
                count += len(table)
        return found.where(slice(count))

    def _parts(
        self, wanted: set[int]
    ) -> Iterator[tuple[Rows, npt.NDArray[Any]] | RecordedDescription | RecordedEvent]:
        """Records of frames and of what sensors they are to be, descriptions and events."""
        sensors = np.full(1 << 16, -1, np.int16)  # by channel; of notes _NOTE
        for channel in wanted:
            sensors[channel] = self._sensor_of[channel]
        sensors[[*self._noted]] = _NOTE
        for rows in self.rows(wanted | self._noted):
            channels = rows[:, CHANNEL].tobytes()
            of = sensors[np.frombuffer(channels, "<u2")]
            edges: Any = []
            if channels != channels[:2] * len(rows):
                rows, of = rows[of >= 0], of[of >= 0]  # noqa: PLW2901
                edges = np.flatnonzero(np.diff(of == _NOTE)) + 1
            elif of[0] < 0:
                continue
            for begin, end in itertools.pairwise([0, *edges, len(of)]):
                if begin < end and of[begin] != _NOTE:
                    yield rows[begin:end], of[begin:end]
                elif begin < end:
                    yield from (self._note(*message_in(row)) for row in rows[begin:end])

    def _note(self, channel: int, log_time_ns: int, body: memoryview) -> RecordedDescription | RecordedEvent:
        topic = self.topics[channel]
        said = file_format.unpack_json(body, topic)
        is_reply = topic == file_format.DESCRIPTION_TOPIC
        return RecordedDescription(log_time_ns, said) if is_reply else RecordedEvent(log_time_ns, said)

    def _channels(self, sensor: int | None) -> set[int]:
        return {number for number, position in self._sensor_of.items() if sensor in (None, position)}


def open_recording(path: Path) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path)
