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
from typing import Final, NamedTuple

import numpy as np

from bota_clients.errors import NothingAskedForError, RecordingError
from bota_clients.numbers import moment, seconds
from bota_clients.recording import file_format
from bota_clients.recording.asked import Asked
from bota_clients.recording.columns import Columns, Table, frames_of, joined, table_of
from bota_clients.recording.file_format import Note, RecordedDescription, RecordedEvent
from bota_clients.recording.mcap_file import CHANNEL, McapFile, Rows, message_in
from bota_clients.recording.order import TimeAxis
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import ImuUnits
from bota_ethercat.replies import SensorInfo
from bota_ethercat.stream.timeline import InForce, Timeline

_MAX_NOTES: Final = 1_000_000  # descriptions and events
_BATCH: Final = 4096  # frames
_NOTE: Final = file_format.MAX_SENSOR + 1
_MAX: Final = (1 << 63) - 1
ALL: Final = Asked()
UNKNOWN: Final = "does not say settings and rate of sensor {}: if need be give --set sinc_length=N, or --rate"
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
        alike = itertools.groupby(self.changes, lambda each: (each.info.identity, each.info.settings))
        return tuple(Since(same[0].stamp_ns, same[-1].in_force) for same in ([*each] for _, each in alike))

    @property
    def offsets(self) -> tuple[Since, ...]:
        """By what the sensor itself adds to every sample (object 0x8000)."""
        alike = itertools.groupby(self.changes, lambda each: each.info.offset)
        return tuple(next(same) for _, same in alike)


def follow(timeline: Timeline, note: Note) -> list[InForce]:
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
        asked: what is asked for: `sensors` and what is read are those of this part.
        cut_off: None if the recording is complete, else a clause that says how it ends.
        metadata: what the recorder wrote at the start, by name (docs/recording.md).
        remarks: what is missing in the file, in clauses.
        chosen: positions given with --sensor; empty for all.
        end: what the recorder wrote at the end, None if it was cut off.
        sensors: the sensors that the server described or that have frames, by position.
        events: every event, oldest first.
    """

    def __init__(self, path: Path, asked: Asked = ALL) -> None:
        self.asked, self.remarks = asked, list[str]()
        super().__init__(path)

    def _open(self) -> None:
        super()._open()
        if self.cut_off is not None:
            self.remarks.append(f"was cut off ({self.cut_off}): the intact part is read")
        # By channel: of which sensor it has frames; _NOTE, or -1: others.
        self._of, counts = np.full(1 << 16, -1, np.int16), Counter[int]()
        for number, topic in self.topics.items():
            if (sensor := file_format.sensor_of_topic(topic)) is not None:
                self._of[number] = sensor
                counts[sensor] += self.counts[number]
            elif topic in (file_format.DESCRIPTION_TOPIC, file_format.EVENTS_TOPIC):
                self._of[number] = _NOTE
        self.metadata = self._metadata(is_rewritten=bool(counts))
        chosen = self.metadata.get("sensors", "")[:_LONGEST_CHOICE].split()
        self.chosen = {int(position) for position in chosen if position.isascii() and position.isdecimal()}
        self.end: Mapping[str, str] | None = self.notes.get(file_format.END_METADATA)
        sensors = self._follow_notes(counts)
        self.sensors = tuple(map(self._in_part, sensors)) if self.asked.part else sensors
        self.frame_count = sum(each.frames for each in self.sensors)
        if self.asked.part and not self.frame_count and any(counts.values()):
            ends = (item["stamp_ns"][[0, -1]] for item in self._tables(None) if isinstance(item, np.ndarray))
            stamps = [stamp for each in ends for stamp in each.tolist()] or [0]  # and not all tables
            begin_ns, end_ns = stamps[0], stamps[-1]
            long = f"it is {seconds((end_ns - begin_ns) * 1e-9)} long, from {moment(begin_ns)} on"
            raise NothingAskedForError(f"{self.path} has nothing {self.asked.part}: {long}")

    def _metadata(self, *, is_rewritten: bool) -> Mapping[str, str]:
        """What the recorder wrote at the start; `is_rewritten`: without it another program wrote the file."""
        found = self.notes.get(file_format.METADATA)
        if found is None and is_rewritten:
            found = {"format": file_format.FORMAT_VERSION}
            self.remarks.append(REWRITTEN)
        if found is None:
            raise RecordingError(f"{self.path} is an MCAP file, but ethercat-record did not write it")
        if found.get("format") != file_format.FORMAT_VERSION:
            raise RecordingError(
                f"{self.path} has format {found.get('format', '?')[:20]!r} and this program reads "
                f"{file_format.FORMAT_VERSION}: use the version that wrote it"
            )
        return found

    def _follow_notes(self, counts: Counter[int]) -> tuple[RecordedSensor, ...]:
        """Take the events; the sensors, of which the file has so many frames."""
        self.events: list[RecordedEvent] = []
        timeline, changes = Timeline(), defaultdict[int, list[Since]](list)
        self._given, told = self.asked.description(counts), dict[int, bool]()  # was it described first?
        for now in timeline.describe(self._given):
            changes[now.sensor].append(Since(0, now))
        notes = (item for item in self._tables(_NOTE) if not isinstance(item, np.ndarray))
        for taken, note in enumerate(notes):
            if taken == _MAX_NOTES:
                raise RecordingError(f"{self.path} has more than {_MAX_NOTES} events")
            for now in follow(timeline, note):
                if not isinstance(note, RecordedEvent) or not note.by_recorder:
                    told.setdefault(now.sensor, isinstance(note, RecordedDescription))
                changes[now.sensor].append(Since(note.stamp_ns, now))
            if isinstance(note, RecordedEvent):
                self.events.append(note)
        unsaid = sorted(position for position in +counts if not told.get(position))
        if self._given and not unsaid:
            raise RecordingError(f"{self.path} says settings and rate itself: omit --set and --rate")
        self.remarks += [] if self._given else map(UNKNOWN.format, unsaid)
        # What a description tells first was in force before it, unless it was given.
        known = [] if self._given else [position for position in told if told[position]]
        self._begin = {position: changes[position][0].in_force for position in known}
        found = {position: tuple(changes[position]) for position in sorted(changes.keys() | counts.keys())}
        return tuple(
            RecordedSensor(position, own[0].info if own else SensorInfo(position), own, counts[position])
            for position, own in found.items()
        )

    def _in_part(self, sensor: RecordedSensor) -> RecordedSensor:
        """With its frames, and what was in force for them."""
        changes, frames = list[Since](), 0
        for in_force, batch in self.batches(sensor.sensor):
            frames += len(batch)
            if in_force.is_described and (not changes or changes[-1].in_force != in_force):
                changes.append(Since(int(batch.stamp_ns[0]), in_force))
        return sensor._replace(
            info=changes[0].info if changes else sensor.info, changes=tuple(changes), frames=frames
        )

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this position, or of all, in the order in which they came.

        RecordingError at the first corrupt part.
        """
        return (item for item in self.everything(sensor) if isinstance(item, DataMessage))

    def everything(self, sensor: int | None = None) -> Iterator[DataMessage | Note]:
        """Descriptions, events and the frames of the sensor at this position, or of all, as they came.

        Of a part its frames, and what was told up to the last of them.
        """
        for item in self.tables(sensor):
            yield from frames_of(item) if isinstance(item, np.ndarray) else [item]

    def tables(self, sensor: int | None = None, *, is_whole: bool = False) -> Iterator[Table | Note]:
        """As `everything`, with the frames as arrays of a few thousand, which descriptions and events end.

        `is_whole`: of all the recording, for what depends on what came before a part.
        """
        if is_whole or not self.asked.part:
            yield from self._tables(sensor)
            return
        axis, begin_ns, told = TimeAxis(), -1, list[Note]()
        for item in self._tables(sensor):
            if not isinstance(item, np.ndarray):
                told.append(item)
                continue
            stamps, moments = (
                np.minimum(item[name], _MAX).astype(np.int64) for name in ("stamp_ns", "monotonic_ns")
            )
            begin_ns = int(moments[0]) if begin_ns < 0 else begin_ns
            held = self.asked.holds(stamps, axis.places(moments, stamps) - begin_ns)
            if held.any():
                yield from told
                told.clear()
                yield item[held]

    def _tables(self, sensor: int | None) -> Iterator[Table | Note]:
        held, count = list[Rows](), 0
        for part in self._parts(sensor):
            if isinstance(part, np.ndarray):
                while count + len(part) >= _BATCH:
                    yield table_of([*held, part[: _BATCH - count]], self._of)
                    held, count, part = [], 0, part[_BATCH - count :]  # noqa: PLW2901
                held, count = [*held, part.copy()], count + len(part)
                continue
            if count:
                yield table_of(held, self._of)
            held, count = [], 0
            if isinstance(part, RecordingError):
                raise part
            if part is not None:
                yield part

    def batches(
        self, sensor: int, imu_units: ImuUnits = ImuUnits.G_DPS, *, is_whole: bool = False
    ) -> Iterator[tuple[InForce, Columns]]:
        """As `tables`, frames of the sensor at this position, with what was in force."""
        timeline = Timeline()
        timeline.describe(self._given)
        in_force = self._begin.get(sensor, timeline[sensor])
        for item in self.tables(sensor, is_whole=is_whole):
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

    def _parts(self, sensor: int | None) -> Iterator[Rows | Note | RecordingError | None]:
        """Descriptions, events and the records of frames, as they came, and at last what ended them.

        _NOTE: no frames.
        """
        sensors, damage = self._of.copy(), None
        if sensor is not None:
            sensors[[number for number in self.topics if sensors[number] not in (sensor, _NOTE)]] = -1
        try:
            for rows in self.rows({number for number in self.topics if sensors[number] >= 0}):
                channels = rows[:, CHANNEL].tobytes()
                of, edges = sensors[np.frombuffer(channels, "<u2")], list[int]()
                if channels != channels[:2] * len(rows):
                    rows, of = rows[of >= 0], of[of >= 0]  # noqa: PLW2901
                    edges = (np.flatnonzero(np.diff(of == _NOTE)) + 1).tolist()
                for begin, end in itertools.pairwise([0, *edges, len(of)]):
                    if begin < end and of[begin] == _NOTE:
                        yield from (self._note(*message_in(row)) for row in rows[begin:end])
                    elif begin < end and of[begin] >= 0:
                        yield rows[begin:end]
        except RecordingError as error:
            damage = error
        yield damage

    def _note(self, channel: int, log_time_ns: int, body: memoryview) -> Note:
        topic = self.topics[channel]
        said = file_format.unpack_json(body, topic)
        is_reply = topic == file_format.DESCRIPTION_TOPIC
        return RecordedDescription(log_time_ns, said) if is_reply else RecordedEvent(log_time_ns, said)


def open_recording(path: Path, asked: Asked = ALL) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path, asked)
