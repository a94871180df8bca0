"""The file format: topics, schemas and message bodies that writer and reader share. docs/recording.md.

Everything is CDR (little-endian) under ROS 2 schemas, because a `ros2 bag` has a single encoding. So a DATA
frame is a message with the fields of the wire protocol, under a schema that is in the file.
"""

from __future__ import annotations

import re
import struct
from typing import Final, NamedTuple

from bota_clients.errors import RecordingError
from bota_ethercat.errors import BadMessageError
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import LAYOUTS
from bota_ethercat.text.json_text import JsonObject, encode_json_text, parse_json_object

FORMAT_VERSION: Final = "1"
PROFILE: Final = "ros2"

# Names of metadata records: at the start, and at the end of a complete recording.
METADATA: Final = "bota_ethercat"
END_METADATA: Final = "bota_ethercat_end"

DESCRIPTION_TOPIC: Final = "/ethercat/description"
EVENTS_TOPIC: Final = "/ethercat/events"
FRAME_SCHEMA: Final = "bota_ethercat/msg/Frame"
TEXT_SCHEMA: Final = "std_msgs/msg/String"
DEFINITIONS: Final = {
    TEXT_SCHEMA: "string data\n",
    FRAME_SCHEMA: """\
# A DATA message of ethercat-server as received, docs/protocol.md
uint64 sequence         # counts this sensor's frames at the server
uint64 stamp_ns         # CLOCK_REALTIME of the sample, ns since 1970
uint64 monotonic_ns     # CLOCK_MONOTONIC of the server's machine, same moment
uint8 sensor            # position on the bus, from 0
uint8 flags             # 1 REPEATED, 2 INVALID, 4 GAP
uint16 wkc              # EtherCAT working counter
uint8[] process_data    # as read from the bus: little-endian, 61 or 77 bytes
""",
}

RECORDER: Final = "recorder"  # the value of `source` in the recorder's own events; the server's have none

_CDR: Final = b"\x00\x01\x00\x00"  # encapsulation header: little-endian, no options
_FRAME: Final = struct.Struct("<4sQQQBBHI")  # without padding: after the header every field is aligned
_TEXT: Final = struct.Struct("<4sI")
_FRAME_TOPIC: Final = re.compile(r"/ethercat/sensor_(0|[1-9][0-9]{0,2})/frames", re.ASCII)
FRAME_SIZE: Final = _FRAME.size  # bytes before the process data
CDR_NUMBER: Final = int.from_bytes(_CDR, "little")
MAX_SENSOR: Final = 255


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
        return self.event.get("source") == RECORDER


Note = RecordedDescription | RecordedEvent


def frame_topic(sensor: int) -> str:
    """The topic of the frames of the sensor at this position."""
    return f"/ethercat/sensor_{sensor}/frames"


def sensor_of_topic(topic: str) -> int | None:
    """The position of the sensor whose frames are on `topic`; None if it is another topic."""
    match = _FRAME_TOPIC.fullmatch(topic)
    sensor = int(match[1]) if match else MAX_SENSOR + 1
    return sensor if sensor <= MAX_SENSOR else None


def pack_frame(frame: DataMessage) -> bytes:
    """The body of a message of FRAME_SCHEMA."""
    data = frame.process_data
    return _FRAME.pack(_CDR, *frame[:6], len(data)) + data


def unpack_frame(body: bytes | memoryview, sensor: int) -> DataMessage:
    """The frame in a message body from the topic of `sensor`; RecordingError if it is none."""
    try:
        cdr, *fields, size = _FRAME.unpack_from(body)
    except struct.error:
        raise RecordingError(f"a frame of sensor {sensor} is only {len(body)} bytes long") from None
    if cdr != _CDR or size not in LAYOUTS or len(body) != _FRAME.size + size or fields[3] != sensor:
        raise RecordingError(
            f"a frame of sensor {sensor} is not in the form that docs/recording.md describes"
        )
    return DataMessage._make((*fields, bytes(body[_FRAME.size :])))


def pack_json(message: JsonObject) -> bytes:
    """The body of a message of TEXT_SCHEMA that has a JSON object as its text."""
    text = encode_json_text(message)
    return _TEXT.pack(_CDR, len(text) + 1) + text + b"\0"


def unpack_json(body: bytes | memoryview, topic: str) -> JsonObject:
    """The JSON object in a message body; RecordingError if there is none."""
    try:
        cdr, size = _TEXT.unpack_from(body)
    except struct.error:
        raise RecordingError(f"a message on {topic} is only {len(body)} bytes long") from None
    text = bytes(body[_TEXT.size :])
    if cdr != _CDR or size != len(text) or not text.endswith(b"\0"):
        raise RecordingError(f"a message on {topic} is not a text in CDR")
    try:
        return parse_json_object(text[:-1])
    except BadMessageError as error:
        raise RecordingError(f"a message on {topic} is not JSON: {error}") from None
