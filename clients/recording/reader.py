"""Reads a recording: who the sensors were, how they were set and when, every frame, every event.

    with open_recording(Path("run.mcap")) as recording:
        for frame in recording.frames(sensor=0):
            ...

A recording that was cut off (a killed recorder, a full disk, a power failure) is read up to its last whole
chunk; `cut_off` says that it was. `columns.py` gives NumPy arrays instead of frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

from clients.recording.container import McapFile, RawMessage
from clients.recording.errors import DamagedError, NotARecordingError, RecordingError
from clients.recording.file_format import (
    DESCRIPTION_TOPIC,
    END_METADATA,
    EVENTS_TOPIC,
    FORMAT_VERSION,
    METADATA,
    RECORDER,
    sensor_of_topic,
    unpack_frame,
    unpack_json,
)
from protocol.framing import DataMessage
from protocol.json_text import JsonObject
from protocol.text import visible
from protocol.untrusted import rows

__all__ = ["DamagedError", "Description", "Event", "NotARecordingError", "RecordedSensor", "Recording",
           "RecordingError", "Settings", "open_recording"]  # fmt: skip

_MAX_NOTES: Final = 1_000_000
"""Descriptions and events that are kept while a recording is open."""


class Description(NamedTuple):
    """What the server said of itself and its sensors, a reply to `describe`."""

    stamp_ns: int
    """When it was received, ns since 1970."""
    reply: JsonObject


class Event(NamedTuple):
    """Something that happened: to the server, or to the recorder (`by_recorder`)."""

    stamp_ns: int
    """When it was received, ns since 1970."""
    event: JsonObject

    @property
    def name(self) -> str:
        """Which event."""
        return str(self.event.get("event", "?"))

    @property
    def by_recorder(self) -> bool:
        """Whether the recorder itself notes it: connected, disconnected, lost."""
        return self.event.get("source") == RECORDER


class Settings(NamedTuple):
    """A sensor's settings and sampling rate from a moment on."""

    stamp_ns: int
    values: Mapping[str, Any]
    rate_hz: float
    """Hz; 0 if it is not known."""


class RecordedSensor(NamedTuple):
    """A sensor of the recording, as it was described first."""

    sensor: int
    """Place on the bus, from 0."""
    name: str
    serial: int
    hardware: str
    firmware: str
    pdo_size: int
    rate_hz: float
    """Hz, nominal; 0 if it is not known."""
    settings: Mapping[str, Any]
    history: tuple[Settings, ...]
    """The settings over time, oldest first; the first are `settings`."""
    frames: int
    """How many frames of it the recording holds."""


class Recording:
    """An open recording. Use it as a context manager, or `close` it.

    Attributes:
        path: where it is.
        metadata: what the recorder noted at the start, texts by name (docs/recording.md).
        end: what it noted at the end, None if it was cut off.
        cut_off: None if the recording was ended, else a clause that says what is wrong with its end.
        sensors: the sensors that the server described or that have frames, by place.
        descriptions: every description, oldest first.
        events: every event, oldest first.
    """

    def __init__(self, path: Path) -> None:
        """RecordingError says why it cannot be read."""
        self.path = path
        try:
            self._file = McapFile(path)
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from None
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        self.cut_off = self._file.cut_off
        found = self._file.metadata.get(METADATA)
        if found is None:
            raise NotARecordingError(f"{self.path} is an MCAP file, but ethercat-record did not write it")
        if found.get("format") != FORMAT_VERSION:
            raise NotARecordingError(
                f"{self.path} has format {found.get('format', '?')[:20]!r} and this program reads "
                f"{FORMAT_VERSION}: use the version that wrote it"
            )
        self.metadata: Mapping[str, str] = found
        self.end: Mapping[str, str] | None = self._file.metadata.get(END_METADATA)
        self._sensor_of: dict[int, int] = {}
        self._topic_of: dict[int, str] = {}
        for number, channel in self._file.channels.items():
            sensor = sensor_of_topic(channel.topic)
            if sensor is not None:
                self._sensor_of[number] = sensor
            elif channel.topic in (DESCRIPTION_TOPIC, EVENTS_TOPIC):
                self._topic_of[number] = channel.topic
        self.descriptions: list[Description] = []
        self.events: list[Event] = []
        for message in self._file.messages(self._topic_of):
            note = self._note(message)
            if isinstance(note, Description):
                self.descriptions.append(note)
            else:
                self.events.append(note)
            if len(self.descriptions) + len(self.events) > _MAX_NOTES:
                raise DamagedError(f"{self.path} has more than {_MAX_NOTES} events")
        self.sensors: tuple[RecordedSensor, ...] = self._find_sensors()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def frame_count(self) -> int:
        """How many frames there are, of all sensors."""
        return sum(self._file.count(number) for number in self._sensor_of)

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this place, or of all, in the order in which they came.

        DamagedError at the first part that is not as it must be.
        """
        places = self._sensor_of
        wanted = {number for number, place in places.items() if sensor in (None, place)}
        for channel, _, body in self._file.messages(wanted):
            yield unpack_frame(body, places[channel])

    def everything(self) -> Iterator[DataMessage | Description | Event]:
        """Frames, descriptions and events, in the order in which they came."""
        places = self._sensor_of
        for message in self._file.messages(places.keys() | self._topic_of.keys()):
            place = places.get(message.channel)
            yield self._note(message) if place is None else unpack_frame(message.body, place)

    def _note(self, message: RawMessage) -> Description | Event:
        topic = self._topic_of[message.channel]
        note = unpack_json(message.body, topic)
        kind = Description if topic == DESCRIPTION_TOPIC else Event
        return kind(message.log_time_ns, note)

    def _find_sensors(self) -> tuple[RecordedSensor, ...]:
        counts: dict[int, int] = {}
        for number, sensor in self._sensor_of.items():
            counts[sensor] = counts.get(sensor, 0) + self._file.count(number)
        first: dict[int, JsonObject] = {}
        history: dict[int, list[Settings]] = {}
        notes: list[Description | Event] = sorted(
            [*self.descriptions, *self.events], key=lambda note: note.stamp_ns
        )
        for note in notes:
            told = rows(note.reply.get("sensors")) if isinstance(note, Description) else [note.event]
            for row in told:
                place, values = row.get("sensor"), row.get("settings")
                if not isinstance(place, int) or isinstance(place, bool) or not isinstance(values, dict):
                    continue
                if isinstance(note, Description):
                    first.setdefault(place, row)
                known = history.setdefault(place, [])
                rate = _number(row.get("rate_hz")) or (known[-1].rate_hz if known else 0.0)
                if not known or (known[-1].values, known[-1].rate_hz) != (values, rate):
                    known.append(Settings(note.stamp_ns, values, rate))
        return tuple(
            _sensor(place, first.get(place, {}), history.get(place, []), counts.get(place, 0))
            for place in sorted(first.keys() | counts.keys())
        )


def open_recording(path: Path) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value < 2**32 else 0.0


def _text(value: object) -> str:
    """Text from a file as it may appear in a line: no control characters, not endless."""
    return visible(str(value)[:80]) if value is not None else "?"


def _sensor(place: int, row: JsonObject, history: list[Settings], frames: int) -> RecordedSensor:
    return RecordedSensor(
        place, _text(row.get("name")), int(_number(row.get("serial"))), _text(row.get("hardware")),
        _text(row.get("firmware")), int(_number(row.get("pdo_size"))), _number(row.get("rate_hz")),
        history[0].values if history else {}, tuple(history), frames,
    )  # fmt: skip
