"""Reads a recording: the sensors, their settings over time, all frames and events.

    with open_recording(Path("run.mcap")) as recording:
        for frame in recording.frames(sensor=0):
            ...

A recording that was cut off (a killed recorder, a full disk, a power failure) is read up to its last complete
chunk; `cut_off` says so. `columns.py` gives NumPy arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from bota_clients.errors import DamagedError, NotARecordingError, RecordingError
from bota_clients.recording.container import McapFile, RawMessage
from bota_clients.recording.file_format import (
    DESCRIPTION_TOPIC,
    END_METADATA,
    EVENTS_TOPIC,
    FORMAT_VERSION,
    METADATA,
    sensor_of_topic,
    unpack_frame,
    unpack_json,
)
from bota_clients.recording.sensors import Description, Event, Histories, Identity, RecordedSensor, Settings
from bota_ethercat.framing import DataMessage

__all__ = ["DamagedError", "Description", "Event", "Identity", "NotARecordingError", "RecordedSensor",
           "Recording", "RecordingError", "Settings", "open_recording"]  # fmt: skip

_MAX_NOTES: Final = 1_000_000
"""Maximum number of descriptions and events."""

_LONGEST_CHOICE: Final = 1024
"""Characters of the list of chosen positions."""


class Recording:
    """An open recording. Use it as a context manager, or `close` it.

    Attributes:
        path: its path.
        metadata: what the recorder wrote at the start, by name (docs/recording.md).
        chosen: positions given with --sensor; empty for all.
        end: what the recorder wrote at the end, None if it was cut off.
        cut_off: None if the recording is complete, else a clause that says how it ends.
        sensors: the sensors that the server described or that have frames, by position.
        descriptions: every description, oldest first.
        events: every event, oldest first.
    """

    def __init__(self, path: Path) -> None:
        """RecordingError if it cannot be read."""
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
        chosen = found.get("sensors", "")[:_LONGEST_CHOICE].split()
        self.chosen = {int(position) for position in chosen if position.isascii() and position.isdecimal()}
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
        histories = Histories()
        for message in self._file.messages(self._topic_of):
            note = self._note(message)
            histories.take(note)
            if isinstance(note, Description):
                self.descriptions.append(note)
            else:
                self.events.append(note)
            if len(self.descriptions) + len(self.events) > _MAX_NOTES:
                raise DamagedError(f"{self.path} has more than {_MAX_NOTES} events")
        counts: dict[int, int] = {}
        for number, sensor in self._sensor_of.items():
            counts[sensor] = counts.get(sensor, 0) + self._file.count(number)
        self.sensors: tuple[RecordedSensor, ...] = histories.sensors(counts)

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
        """Number of frames of all sensors."""
        return sum(self._file.count(number) for number in self._sensor_of)

    def frames(self, sensor: int | None = None) -> Iterator[DataMessage]:
        """The frames of the sensor at this position, or of all, in the order in which they came.

        DamagedError at the first corrupt part.
        """
        positions = self._sensor_of
        wanted = {number for number, position in positions.items() if sensor in (None, position)}
        for channel, _, body in self._file.messages(wanted):
            yield unpack_frame(body, positions[channel])

    def everything(self, sensor: int | None = None) -> Iterator[DataMessage | Description | Event]:
        """Descriptions, events and the frames of the sensor at this position, or of all, as they came."""
        positions = self._sensor_of
        wanted = {number for number, position in positions.items() if sensor in (None, position)}
        for message in self._file.messages(wanted | self._topic_of.keys()):
            position = positions.get(message.channel)
            yield self._note(message) if position is None else unpack_frame(message.body, position)

    def _note(self, message: RawMessage) -> Description | Event:
        topic = self._topic_of[message.channel]
        note = unpack_json(message.body, topic)
        kind = Description if topic == DESCRIPTION_TOPIC else Event
        return kind(message.log_time_ns, note)


def open_recording(path: Path) -> Recording:
    """Open the recording at `path`; RecordingError says in one sentence why it cannot be read."""
    return Recording(path)
