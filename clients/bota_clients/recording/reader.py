"""Reads a recording: the sensors, their settings over time, all frames and events.

    with open_recording(Path("run.mcap")) as recording:
        for frame in recording.frames(sensor=0):
            ...

A recording that was cut off (a killed recorder, a full disk, a power failure) is read up to its last complete
chunk; `cut_off` says so. `columns.py` gives NumPy arrays.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from bota_clients.errors import RecordingError
from bota_clients.recording import file_format
from bota_clients.recording.mcap_file import McapFile
from bota_ethercat import replies
from bota_ethercat.framing import DataMessage
from bota_ethercat.replies import SensorInfo, position_of
from bota_ethercat.text.json_text import JsonObject

_MAX_NOTES: Final = 1_000_000  # descriptions and events
_BATCH: Final = 4096  # frames
_LONGEST_CHOICE: Final = 1024  # characters of the list of chosen positions


class RecordedDescription(NamedTuple):
    """A reply to `describe`."""

    stamp_ns: int  # when it was received, ns since 1970
    reply: JsonObject


class RecordedEvent(NamedTuple):
    """An event of the server, or of the recorder (`by_recorder`)."""

    stamp_ns: int  # when it was received, ns since 1970
    event: JsonObject

    @property
    def name(self) -> str:
        return str(self.event.get("event", "?"))

    @property
    def by_recorder(self) -> bool:
        """Whether it is the recorder's own: connected, disconnected, lost."""
        return self.event.get("source") == file_format.RECORDER


class InForce(NamedTuple):
    """What a sensor was from a time on: its identity, settings, rate, and its latest own offset."""

    stamp_ns: int
    info: SensorInfo

    def is_changed(self, info: SensorInfo) -> bool:
        """Whether `info` is of another sensor, or has other settings."""
        before = self.info
        is_other = _identity(before) not in (_identity(info), _identity(SensorInfo()))
        return is_other or before.settings != info.settings


class Offset(NamedTuple):
    """What a sensor itself adds to every sample (object 0x8000) from a time on."""

    stamp_ns: int
    offset: tuple[float, ...] | None  # N and Nm; None if unknown


class RecordedSensor(NamedTuple):
    """A sensor of the recording."""

    sensor: int  # position on the bus, from 0
    info: SensorInfo  # as first described
    history: tuple[InForce, ...]  # over time, oldest first; empty if it was never described
    frames: int  # number of its frames in the recording
    offsets: tuple[Offset, ...]  # over time, oldest first


class Histories:
    """The histories of all sensors, built from descriptions and events in file order."""

    def __init__(self) -> None:
        self._of: dict[int, list[InForce]] = {}
        self._offsets: dict[int, list[Offset]] = {}

    def apply(self, note: RecordedDescription | RecordedEvent) -> None:
        """Take the next description or event of the file."""
        if isinstance(note, RecordedDescription):
            for info in replies.Description.parse(note.reply).sensors:
                self._learn(note.stamp_ns, info)
        elif (position := position_of(note.event)) is not None and {"settings", "offset"} & note.event.keys():
            self._learn(note.stamp_ns, self.newest(position).changed_by(note.event))

    def newest(self, position: int) -> SensorInfo:
        """What the sensor at this position is by all that was taken."""
        history = self._of.get(position)
        return history[-1].info if history else SensorInfo(position)

    def sensors(self, frames: Mapping[int, int]) -> tuple[RecordedSensor, ...]:
        """All sensors that were described or that have `frames`, which are counts by position."""
        found = []
        for position in sorted(self._of.keys() | frames.keys()):
            history, offsets = tuple(self._of.get(position, ())), tuple(self._offsets.get(position, ()))
            first = history[0].info if history else SensorInfo(position)
            found.append(RecordedSensor(position, first, history, frames.get(position, 0), offsets))
        return tuple(found)

    def _learn(self, stamp_ns: int, info: SensorInfo) -> None:
        known, offsets = self._of.setdefault(info.sensor, []), self._offsets.setdefault(info.sensor, [])
        if not offsets or offsets[-1].offset != info.offset:
            offsets.append(Offset(stamp_ns, info.offset))
        if not known or known[-1].is_changed(info):
            known.append(InForce(stamp_ns, info))
        else:  # the description that follows an event completes the same entry
            known[-1] = known[-1]._replace(info=info)


def _identity(info: SensorInfo) -> tuple[object, ...]:
    return info.name, info.serial, info.hardware, info.firmware


class Recording(McapFile):
    """An open recording. Use it as a context manager, or `close` it.

    Attributes:
        path: its path.
        cut_off: None if the recording is complete, else a clause that says how it ends.
        metadata: what the recorder wrote at the start, by name (docs/recording.md).
        chosen: positions given with --sensor; empty for all.
        end: what the recorder wrote at the end, None if it was cut off.
        sensors: the sensors that the server described or that have frames, by position.
        events: every event, oldest first.
    """

    def _open(self) -> None:
        super()._open()
        found = self.notes.get(file_format.METADATA)
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
        histories = Histories()
        for taken, note in enumerate(self._read(self._noted)):
            if taken == _MAX_NOTES:
                raise RecordingError(f"{self.path} has more than {_MAX_NOTES} events")
            if not isinstance(note, DataMessage):
                histories.apply(note)
            if isinstance(note, RecordedEvent):
                self.events.append(note)
        self.sensors: tuple[RecordedSensor, ...] = histories.sensors(counts)

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this position, or of all, in the order in which they came.

        RecordingError at the first corrupt part.
        """
        frames = self._read(self._channels(sensor))
        return cast(Iterator[DataMessage], frames)

    def everything(
        self, sensor: int | None = None
    ) -> Iterator[DataMessage | RecordedDescription | RecordedEvent]:
        """Descriptions, events and the frames of the sensor at this position, or of all, as they came."""
        return self._read(self._channels(sensor) | self._noted)

    def batches(self, sensor: int) -> Iterator[tuple[SensorInfo, list[DataMessage]]]:
        """Frames of the sensor at this position, a few thousand at once, with what was in force."""
        histories, info = Histories(), SensorInfo(sensor)
        for known in self.sensors:
            if known.sensor == sensor and known.history:  # in force before it was told
                info = known.info._replace(offset=known.offsets[0].offset)
        for kind, items in itertools.groupby(self.everything(sensor), type):
            while batch := cast(Any, [*itertools.islice(items, _BATCH)]):
                if kind is DataMessage:
                    yield info, batch
                else:
                    for note in batch:
                        histories.apply(note)
                    newest = histories.newest(sensor)
                    info = info if newest == SensorInfo(sensor) else newest

    def _channels(self, sensor: int | None) -> set[int]:
        return {number for number, position in self._sensor_of.items() if sensor in (None, position)}

    def _read(self, channels: set[int]) -> Iterator[DataMessage | RecordedDescription | RecordedEvent]:
        for channel, log_time_ns, body in self.messages(channels):
            position, topic = self._sensor_of.get(channel), self.topics[channel]
            if position is not None:
                yield file_format.unpack_frame(body, position)
            elif topic == file_format.DESCRIPTION_TOPIC:
                yield RecordedDescription(log_time_ns, file_format.unpack_json(body, topic))
            else:
                yield RecordedEvent(log_time_ns, file_format.unpack_json(body, topic))


def open_recording(path: Path) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path)
