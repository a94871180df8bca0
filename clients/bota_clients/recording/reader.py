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
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from bota_clients.errors import RecordingError
from bota_clients.recording import file_format
from bota_clients.recording.container import McapFile
from bota_ethercat.control import known_six
from bota_ethercat.errors import SettingError
from bota_ethercat.framing import DataMessage
from bota_ethercat.settings import SETTINGS, sampling_rate_hz
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import rows, visible, whole

_MAX_NOTES: Final = 1_000_000  # descriptions and events
_BATCH: Final = 4096  # frames
_LONGEST_CHOICE: Final = 1024  # characters of the list of chosen positions


class Description(NamedTuple):
    """A reply to `describe`."""

    stamp_ns: int  # when it was received, ns since 1970
    reply: JsonObject


class Event(NamedTuple):
    """An event of the server, or of the recorder (`by_recorder`)."""

    stamp_ns: int  # when it was received, ns since 1970
    event: JsonObject

    @property
    def name(self) -> str:
        """Name of the event."""
        return str(self.event.get("event", "?"))

    @property
    def by_recorder(self) -> bool:
        """Whether it is the recorder's own: connected, disconnected, lost."""
        return self.event.get("source") == file_format.RECORDER


class Identity(NamedTuple):
    """Identity of a sensor."""

    name: str = "?"
    serial: int = 0
    hardware: str = "?"
    firmware: str = "?"
    pdo_size: int = 0


class Settings(NamedTuple):
    """Settings, sampling rate and identity of a sensor from a time on, and its latest own offset."""

    stamp_ns: int = 0
    values: Mapping[str, Any] = {}
    rate_hz: float = 0.0  # 0 if unknown
    identity: Identity = Identity()
    offset: tuple[float, ...] | None = None  # that it adds (0x8000), N and Nm; None if unknown


class Offset(NamedTuple):
    """What a sensor itself adds to every sample (object 0x8000) from a time on."""

    stamp_ns: int
    offset: tuple[float, ...] | None  # N and Nm; None if unknown


class RecordedSensor(NamedTuple):
    """A sensor of the recording, as first described."""

    sensor: int  # position on the bus, from 0
    name: str
    serial: int
    hardware: str
    firmware: str
    pdo_size: int
    rate_hz: float  # nominal; 0 if unknown
    settings: Mapping[str, Any]
    history: tuple[Settings, ...]  # over time, oldest first; the first are the ones here
    frames: int  # number of its frames in the recording
    offsets: tuple[Offset, ...] = ()  # over time, oldest first


class Histories:
    """The histories of all sensors, built from descriptions and events in file order."""

    def __init__(self) -> None:
        self._of: dict[int, list[Settings]] = {}
        self._offsets: dict[int, list[Offset]] = {}

    def take(self, note: Description | Event) -> None:
        """Take the next description or event of the file."""
        described = isinstance(note, Description)
        for row in rows(note.reply.get("sensors")) if isinstance(note, Description) else [note.event]:
            position = whole(row.get("sensor"))
            if position is None or not 0 <= position <= file_format.MAX_SENSOR:
                continue
            if isinstance(row.get("settings"), dict) or (not described and "offset" in row):
                self._learn(position, note.stamp_ns, row, described=described)

    def of(self, position: int) -> Sequence[Settings]:
        """The history so far of the sensor at this position."""
        return self._of.get(position, ())

    def sensors(self, frames: Mapping[int, int]) -> tuple[RecordedSensor, ...]:
        """All sensors that were described or that have `frames`, which are counts by position."""
        found = []
        for position in sorted(self._of.keys() | frames.keys()):
            history = tuple(self.of(position))
            first = history[0] if history else Settings()
            about = (*first.identity, first.rate_hz, first.values, history)
            offsets = tuple(self._offsets.get(position, ()))
            found.append(RecordedSensor(position, *about, frames.get(position, 0), offsets))
        return tuple(found)

    def _learn(self, position: int, stamp_ns: int, row: JsonObject, *, described: bool) -> None:
        known, offsets = self._of.setdefault(position, []), self._offsets.setdefault(position, [])
        last = known[-1] if known else Settings()
        identity, values = last.identity, row.get("settings")
        values = values if isinstance(values, dict) else last.values
        offset = known_six(row["offset"]) if "offset" in row else last.offset
        if not offsets or offsets[-1].offset != offset:
            offsets.append(Offset(stamp_ns, offset))
        if described:
            name, hardware, firmware = (_text(row.get(key)) for key in ("name", "hardware", "firmware"))
            serial, size = (int(_number(row.get(key))) for key in ("serial", "pdo_size"))
            identity = Identity(name, serial, hardware, firmware, size)
        rate = _number(row.get("rate_hz"))
        if known and last.values == values and last.identity in (identity, Identity()):
            # The description that follows an event completes the same entry.
            known[-1] = last._replace(rate_hz=rate or last.rate_hz, identity=identity, offset=offset)
        else:
            known.append(Settings(stamp_ns, values, rate or _rate(values, last), identity, offset))


def _rate(values: Mapping[str, Any], last: Settings) -> float:
    """The rate that the settings imply where it is not given."""
    try:
        length = SETTINGS["sinc_length"].check(values.get("sinc_length"))
    except SettingError:
        return last.rate_hz
    return last.rate_hz if length == last.values.get("sinc_length") else float(sampling_rate_hz(length))


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value < 2**32 else 0.0


def _text(value: object) -> str:
    """Text from a file, safe to print: no control characters, limited length."""
    return visible(str(value)[:80]) if value is not None else "?"


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
        self.events: list[Event] = []
        histories = Histories()
        for taken, note in enumerate(self._read(self._noted)):
            if taken == _MAX_NOTES:
                raise RecordingError(f"{self.path} has more than {_MAX_NOTES} events")
            if not isinstance(note, DataMessage):
                histories.take(note)
            if isinstance(note, Event):
                self.events.append(note)
        self.sensors: tuple[RecordedSensor, ...] = histories.sensors(counts)

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this position, or of all, in the order in which they came.

        RecordingError at the first corrupt part.
        """
        frames = self._read(self._channels(sensor))
        return cast(Iterator[DataMessage], frames)

    def everything(self, sensor: int | None = None) -> Iterator[DataMessage | Description | Event]:
        """Descriptions, events and the frames of the sensor at this position, or of all, as they came."""
        return self._read(self._channels(sensor) | self._noted)

    def batches(self, sensor: int) -> Iterator[tuple[Settings, list[DataMessage]]]:
        """Frames of the sensor at this position, a few thousand at once, with what was in force."""
        histories = Histories()
        known = [each for each in self.sensors if each.sensor == sensor and each.history]
        settings = Settings()
        for each in known:
            settings = each.history[0]._replace(offset=each.offsets[0].offset)
        for kind, items in itertools.groupby(self.everything(sensor), type):
            while batch := cast(Any, [*itertools.islice(items, _BATCH)]):
                if kind is DataMessage:
                    yield settings, batch
                else:
                    for note in batch:
                        histories.take(note)
                    settings = (histories.of(sensor) or (settings,))[-1]

    def _channels(self, sensor: int | None) -> set[int]:
        return {number for number, position in self._sensor_of.items() if sensor in (None, position)}

    def _read(self, channels: set[int]) -> Iterator[DataMessage | Description | Event]:
        for channel, log_time_ns, body in self.messages(channels):
            position, topic = self._sensor_of.get(channel), self.topics[channel]
            if position is not None:
                yield file_format.unpack_frame(body, position)
            elif topic == file_format.DESCRIPTION_TOPIC:
                yield Description(log_time_ns, file_format.unpack_json(body, topic))
            else:
                yield Event(log_time_ns, file_format.unpack_json(body, topic))


def open_recording(path: Path) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path)
