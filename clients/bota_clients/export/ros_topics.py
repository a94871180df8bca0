"""What `ethercat-export RECORDING --ros OUT.mcap` does: the samples as ROS topics, for tools that show those.

Names, types and frames are the node's: `wrench`, `wrench_compensated` with a tool, `imu/data_raw`,
`temperature`. Stamps are the samples'; what was lost, repeated or invalid has no message, nor has what is
not finite. Covariances are 0, unknown (REP 145).
"""

from __future__ import annotations

import argparse
import struct
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

from bota_clients.export.cli import PROGRAM
from bota_clients.export.csv_table import AXES
from bota_clients.export.dataset import windows_for
from bota_clients.export.samples import MOST_LOST, in_part, samples_of
from bota_clients.export.windows import Arrays
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.recording.mcap_writer import McapWriter, message_rows, whole_file
from bota_clients.recording.reader import Recording
from bota_ethercat.program.version import VERSION

_STORE: Final[Any] = get_typestore(Stores.ROS2_JAZZY)
_STAMP: Final = slice(4, 12)  # s and ns, behind the bytes that say CDR, little-endian


class Topic(NamedTuple):
    """A topic: the message's type, and where in its numbers, which end it, what columns are."""

    name: str
    kind: str
    frame: str
    places: Sequence[int]  # of each column among the float64 at the message's end
    columns: Sequence[str]
    valid: str = ""  # a column that says whether the others may be used

    def message(self) -> bytes:
        """In CDR, little-endian, with a stamp and numbers of 0."""
        text = self.frame.encode() + b"\0"
        head = bytes(8) + struct.pack("<I", len(text)) + text
        numbers = np.zeros(_NUMBERS.get(self.kind, 2))
        if self.kind == _IMU:
            numbers[4] = -1.0  # the covariance of an orientation that there is not
        return b"\0\1\0\0" + head + bytes(-len(head) % 8) + numbers.tobytes()


_WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
_IMU: Final = "sensor_msgs/msg/Imu"
TOPICS: Final = (
    Topic("wrench", _WRENCH, "ft_sensor", range(6), AXES[:6]),
    Topic(
        "wrench_compensated", _WRENCH, "ft_sensor", range(6), [f"compensated_{each}" for each in AXES[:6]],
        "compensated_valid",
    ),
    Topic("imu/data_raw", _IMU, "ft_sensor_imu", (13, 14, 15, 25, 26, 27), AXES[9:] + AXES[6:9]),
    Topic("temperature", "sensor_msgs/msg/Temperature", "ft_sensor", (0,), ["temperature_degC"]),
)  # fmt: skip
_NUMBERS: Final = {_WRENCH: 6, _IMU: 37}  # float64 at the end; of others 2


def write(options: argparse.Namespace, recording: Recording) -> str:
    """The topics of a sensor into a file; says how many messages. RecordingError."""
    sensor = choose(recording, options.sensor)
    windows = windows_for(options, recording, sensor, MOST_LOST)
    with whole_file(options.output, force=options.force) as disk:
        writer = McapWriter(disk, "ros2", f"{PROGRAM} {VERSION}")
        wanted = [topic for topic in TOPICS if windows.stream or not topic.valid]
        senders, sent = [_Sender(writer, topic) for topic in wanted], 0
        for block in in_part(recording, windows, samples_of(recording, windows, sensor.sensor)):
            sent += sum(each.send(block) for each in senders)
            disk.flush()
        writer.finish()
        disk.sync()
    return "; ".join(
        [f"{count(sent, 'message')} on {', '.join(topic.name for topic in wanted)}", *windows.axis.said]
    )


class _Sender:
    """Writes one topic."""

    def __init__(self, writer: McapWriter, topic: Topic) -> None:
        definition = _STORE.generate_msgdef(topic.kind, ros_version=2)[0]
        self._writer, self._topic, self._sent = writer, topic, 0
        self._channel = writer.channel(f"/{topic.name}", topic.kind, definition)
        self._message = np.frombuffer(topic.message(), np.uint8)
        self._begin = len(self._message) - 8 * _NUMBERS.get(topic.kind, 2)

    def send(self, block: Arrays) -> int:
        """The samples of these rows of which all numbers are known; how many."""
        topic = self._topic
        values = np.column_stack([block[name] for name in topic.columns]).astype(np.float64)
        known = np.isfinite(values).all(axis=1)
        if topic.valid:
            known &= block[topic.valid]
        stamps = block["stamp_utc"][known].astype(np.int64)
        bodies = np.tile(self._message, (len(stamps), 1))
        bodies[:, _STAMP].view("<i4")[:] = np.column_stack(np.divmod(stamps, 10**9))
        bodies[:, self._begin :].view("<f8")[:, topic.places] = values[known]
        self._writer.messages(message_rows(self._channel, stamps, bodies, self._sent))
        self._sent += len(stamps)
        return len(stamps)
