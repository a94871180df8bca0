"""Writes one recording file: frames, descriptions and events as MCAP messages.

Call `flush` often: what was flushed survives this process. Not thread-safe.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO, Any, Final, cast

from mcap.writer import CompressionType, Writer

from bota_clients.recording.disk import DiskFile
from bota_clients.recording.file_format import (
    DESCRIPTION_TOPIC,
    ENCODING,
    END_METADATA,
    EVENTS_TOPIC,
    FRAME_DEFINITION,
    FRAME_SCHEMA,
    METADATA,
    PROFILE,
    SCHEMA_ENCODING,
    TEXT_DEFINITION,
    TEXT_SCHEMA,
    frame_topic,
    pack_frame,
    pack_json,
)
from bota_ethercat.framing import DataMessage
from bota_ethercat.text.json_text import JsonObject

_CHUNK_SIZE: Final = 1024 * 1024
_U32: Final = 0xFFFFFFFF


class RecordingWriter:
    """A recording file that is being written.

    Attributes:
        frames: number of frames written.
    """

    def __init__(self, disk: DiskFile, library: str, notes: Mapping[str, str]) -> None:
        """Start the file: `notes` become its metadata."""
        self.frames = 0
        self._disk = disk
        self._mcap = Writer(
            cast("IO[Any]", disk),
            chunk_size=_CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self._mcap.start(PROFILE, library)
        self._mcap.add_metadata(METADATA, dict(notes))
        self._schemas: dict[str, int] = {}
        self._descriptions = self._channel(DESCRIPTION_TOPIC, TEXT_SCHEMA, TEXT_DEFINITION)
        self._events = self._channel(EVENTS_TOPIC, TEXT_SCHEMA, TEXT_DEFINITION)
        self._notes = 0
        self._frame_channels: dict[int, int] = {}

    @property
    def size(self) -> int:
        """Size of the file in bytes, without the current chunk."""
        return self._disk.tell()

    def describe(self, stamp_ns: int, description: JsonObject) -> None:
        """Write a reply to `describe`."""
        self._note(self._descriptions, stamp_ns, description)

    def event(self, stamp_ns: int, event: JsonObject) -> None:
        """Write an event received at `stamp_ns`."""
        self._note(self._events, stamp_ns, event)

    def frame(self, frame: DataMessage) -> None:
        """Write a frame."""
        channel = self._frame_channels.get(frame.sensor)
        if channel is None:
            channel = self._channel(frame_topic(frame.sensor), FRAME_SCHEMA, FRAME_DEFINITION)
            self._frame_channels[frame.sensor] = channel
        stamp_ns = frame.stamp_ns
        self._mcap.add_message(channel, stamp_ns, pack_frame(frame), stamp_ns, frame.sequence & _U32)
        self.frames += 1

    def flush(self) -> None:
        """End the chunk and write it to disk; DiskError if it cannot be written."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def finish(self, notes: Mapping[str, str]) -> None:
        """Write what is buffered, the index and the footer, and synchronize the disk; DiskError."""
        self.flush()
        self._mcap.add_metadata(END_METADATA, dict(notes))
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._disk.flush()
        self._disk.sync()

    def _note(self, channel: int, stamp_ns: int, message: JsonObject) -> None:
        self._mcap.add_message(channel, stamp_ns, pack_json(message), stamp_ns, self._notes)
        self._notes += 1

    def _channel(self, topic: str, schema: str, definition: str) -> int:
        number = self._schemas.get(schema)
        if number is None:
            number = self._mcap.register_schema(schema, SCHEMA_ENCODING, definition.encode())
            self._schemas[schema] = number
        # An empty profile: `ros2 bag play` uses its own, which is reliable, as the node's is.
        return self._mcap.register_channel(topic, ENCODING, number, {"offered_qos_profiles": ""})
