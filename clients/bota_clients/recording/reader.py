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

from bota_clients.errors import NothingAskedForError, RecordingError
from bota_clients.numbers import moment, seconds
from bota_clients.recording import file_format
from bota_clients.recording.asked import Asked
from bota_clients.recording.columns import Columns, Table, frames_of, joined, table_of
from bota_clients.recording.file_format import RecordedDescription, RecordedEvent
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


_Part = tuple[Rows, npt.NDArray[Any]] | RecordedDescription | RecordedEvent


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
        found = self.notes.get(file_format.METADATA)
        if found is None and any(
            file_format.sensor_of_topic(topic) is not None for topic in self.topics.values()
        ):
            found = {"format": file_format.FORMAT_VERSION}
            self.remarks.append(REWRITTEN)
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
        self.events: list[RecordedEvent] = []
        timeline, changes = Timeline(), defaultdict[int, list[Since]](list)
        self._given, told = self.asked.description(counts), dict[int, bool]()  # was it described first?
        for now in timeline.describe(self._given):
            changes[now.sensor].append(Since(0, now))
        for taken, note in enumerate(self._parts(set())):
            if taken == _MAX_NOTES:
                raise RecordingError(f"{self.path} has more than {_MAX_NOTES} events")
            if not isinstance(note, RecordedDescription | RecordedEvent):
                continue
            for now in follow(timeline, note):
                if not isinstance(note, RecordedEvent) or not note.by_recorder:
                    told.setdefault(now.sensor, isinstance(note, RecordedDescription))
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
        unsaid = sorted(position for position in +counts if not told.get(position))
        if self._given and not unsaid:
            raise RecordingError(f"{self.path} says settings and rate itself: omit --set and --rate")
        self.remarks += [] if self._given else map(UNKNOWN.format, unsaid)
        # What a description tells first was in force before it.
        known = unsaid if self._given else [position for position in told if told[position]]
        self._begin = {position: changes[position][0].in_force for position in known}
        if self.asked.part:
            self.sensors = tuple(map(self._in_part, self.sensors))
        self.frame_count = sum(each.frames for each in self.sensors)
        if self.asked.part and not self.frame_count and any(counts.values()):
            ends = (item["stamp_ns"][[0, -1]] for item in self._tables(None) if isinstance(item, np.ndarray))
            stamps = [stamp for each in ends for stamp in each.tolist()] or [0]  # and not all tables
            begin_ns, end_ns = stamps[0], stamps[-1]
            long = f"it is {seconds((end_ns - begin_ns) * 1e-9)} long, from {moment(begin_ns)} on"
            raise NothingAskedForError(f"{self.path} has nothing {self.asked.part}: {long}")

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

    def everything(
        self, sensor: int | None = None
    ) -> Iterator[DataMessage | RecordedDescription | RecordedEvent]:
        """Descriptions, events and the frames of the sensor at this position, or of all, as they came.

        Of a part its frames, and what was told up to the last of them.
        """
        for item in self.tables(sensor):
            yield from frames_of(item) if isinstance(item, np.ndarray) else [item]

    def tables(
        self, sensor: int | None = None, *, is_whole: bool = False
    ) -> Iterator[Table | RecordedDescription | RecordedEvent]:
        """As `everything`, with the frames as arrays of a few thousand, which descriptions and events end.

        `is_whole`: of all the recording, for what depends on what came before a part.
        """
        if is_whole or not self.asked.part:
            yield from self._tables(sensor)
            return
        axis, begin_ns, told = TimeAxis(), -1, list[RecordedDescription | RecordedEvent]()
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

    def _tables(self, sensor: int | None) -> Iterator[Table | RecordedDescription | RecordedEvent]:
        held, sensors, count = list[Rows](), list[npt.NDArray[Any]](), 0
        for part in self._until_damage(self._channels(sensor)):
            if part is None or isinstance(part, RecordedDescription | RecordedEvent | RecordingError):
                if count:
                    yield table_of(held, np.concatenate(sensors))
                held, sensors, count = [], [], 0
                if isinstance(part, RecordingError):
                    raise part
                if part is not None:
                    yield part
                continue
            rows, of = part
            while count + len(rows) >= _BATCH:
                left = _BATCH - count
                yield table_of([*held, rows[:left]], np.concatenate([*sensors, of[:left]]))
                held, sensors, count, rows, of = [], [], 0, rows[left:], of[left:]
            held, sensors, count = [*held, rows.copy()], [*sensors, of], count + len(rows)

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

    def _until_damage(self, wanted: set[int]) -> Iterator[_Part | RecordingError | None]:
        """As `_parts`, and at last what ended it."""
        try:
            yield from self._parts(wanted)
            yield None
        except RecordingError as error:
            yield error

    def _parts(self, wanted: set[int]) -> Iterator[_Part]:
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


def open_recording(path: Path, asked: Asked = ALL) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path, asked)
