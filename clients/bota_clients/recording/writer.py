"""Writes one recording file: frames, descriptions and events as MCAP messages.

What was flushed stays intact, whatever happens to the process or the disk: a flush writes complete MCAP
records, and if the disk takes only a part of them, the file is truncated again. Not thread-safe.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from bota_clients.recording import file_format
from bota_clients.recording.columns import Table
from bota_clients.recording.file_format import Note, RecordedDescription
from bota_clients.recording.mcap_writer import DiskFile, McapWriter
from bota_ethercat.framing import DataMessage

_U32: Final = 0xFFFFFFFF


class RecordingWriter:
    """A recording file that is being written. Call `flush` often: what was flushed survives this process.

    Attributes:
        frames: number of frames written.
    """

    def __init__(self, disk: DiskFile, library: str, notes: Mapping[str, str]) -> None:
        """Start the file: `notes` become its metadata."""
        self.frames = 0
        self._disk = disk
        self._mcap = McapWriter(disk, file_format.PROFILE, library)
        self._mcap.metadata(file_format.METADATA, {"format": file_format.FORMAT_VERSION, **notes})
        self._descriptions = self._channel(file_format.DESCRIPTION_TOPIC, file_format.TEXT_SCHEMA)
        self._events = self._channel(file_format.EVENTS_TOPIC, file_format.TEXT_SCHEMA)
        self._notes = 0
        self._frame_channels: dict[int, int] = {}

    def note(self, note: Note) -> None:
        """Write a description or an event."""
        channel = self._descriptions if isinstance(note, RecordedDescription) else self._events
        self._mcap.message(channel, note.stamp_ns, file_format.pack_json(note[1]), self._notes)
        self._notes += 1

    def frame(self, frame: DataMessage) -> None:
        """Write a frame that was received."""
        channel = self._frame_channels.get(frame.sensor) or self._frame_channel(frame.sensor)
        self._mcap.message(channel, frame.stamp_ns, file_format.pack_frame(frame), frame.sequence & _U32)
        self.frames += 1

    def table(self, frames: Table) -> None:
        """Write frames that were read."""
        made = frames.copy()
        for sensor in np.unique(made["sensor"]).tolist():
            made["channel"][made["sensor"] == sensor] = self._frame_channel(sensor)
        made["number"], made["logged"] = made["sequence"], made["stamp_ns"]
        made["published"] = made["stamp_ns"]
        self._mcap.messages(made.view(np.uint8).reshape(len(made), -1))
        self.frames += len(made)

    def flush(self) -> None:
        """End the chunk and write it to disk; RecordingError if it cannot be written."""
        self._mcap.flush()

    def finish(self, notes: Mapping[str, str] | None) -> None:
        """Write what is buffered, `notes`, index and footer, synchronize the disk, close; RecordingError."""
        self.flush()
        if notes is not None:
            self._mcap.metadata(file_format.END_METADATA, notes)
        self._mcap.finish()
        self._disk.sync()
        self._disk.close()

    def _frame_channel(self, sensor: int) -> int:
        if sensor not in self._frame_channels:
            topic = file_format.frame_topic(sensor)
            self._frame_channels[sensor] = self._channel(topic, file_format.FRAME_SCHEMA)
        return self._frame_channels[sensor]

    def _channel(self, topic: str, schema: str) -> int:
        # An empty profile: `ros2 bag play` uses its own, which is reliable, as the node's is.
        return self._mcap.channel(topic, schema, file_format.DEFINITIONS[schema], offered_qos_profiles="")
