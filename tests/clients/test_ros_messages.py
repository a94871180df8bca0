"""A recording with --ros is a ROS 2 bag: other libraries open it as it is and find the right values in it."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from clients.recording.file_format import FRAME_SCHEMA, frame_topic
from clients.recording.ros_messages import DEFINITIONS, RosTopics
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import ImuUnits, SampleDecoder
from tests.clients.recordings import START_NS, describe, frame, writer

VALUES: dict[str, Any] = {
    "force.y": -2.25, "force.z": 1e-3, "torque.x": 0.5, "torque.y": -0.125, "torque.z": 3.5,
    "acceleration.x": 0.1, "acceleration.y": -0.2, "acceleration.z": 0.99,
    "angular_rate.x": 10.0, "angular_rate.y": -20.0, "angular_rate.z": 0.5,
}  # fmt: skip
ORIENTATION: dict[str, Any] = {"orientation.x": 0.5, "orientation.z": -0.5, "orientation.w": 0.70710678}
NOT_FINITE: dict[str, Any] = {"torque.y": math.nan}
FRAMES = [
    frame(0, **VALUES),
    frame(1, flags=DataFlag.REPEATED, **VALUES),
    frame(2, flags=DataFlag.INVALID, **VALUES),
    frame(3, flags=DataFlag.GAP, size=77, **VALUES, **ORIENTATION),
    frame(4, **NOT_FINITE),
]
NEW = [FRAMES[0], FRAMES[3], FRAMES[4]]


@pytest.fixture(params=["", "left/arm"])
def namespace(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def bag(tmp_path: Path, namespace: str) -> Path:
    path = tmp_path / "bag.mcap"
    made = writer(path, {0: RosTopics(namespace)})
    made.describe(START_NS, describe(0))
    for item in FRAMES:
        made.frame(item)
    made.finish({})
    return path


def topic(namespace: str, name: str) -> str:
    return f"/{namespace}/{name}" if namespace else f"/{name}"


def check_wrench(message: Any, item: DataMessage, namespace: str) -> None:
    sample = SampleDecoder(len(item.process_data)).decode(item.process_data)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(item.stamp_ns, 10**9)
    assert message.header.frame_id == (f"{namespace}_ft_sensor" if namespace else "ft_sensor")
    force, torque = message.wrench.force, message.wrench.torque
    assert (force.x, force.y, force.z) == sample.force
    assert (torque.x, torque.y, torque.z) == sample.torque


def check_imu(message: Any, item: DataMessage, namespace: str, *, oriented: bool = False) -> None:
    sample = SampleDecoder(len(item.process_data)).decode(item.process_data)
    assert message.header.frame_id == (f"{namespace}_ft_sensor_imu" if namespace else "ft_sensor_imu")
    a, r, q = message.linear_acceleration, message.angular_velocity, message.orientation
    assert (a.x, a.y, a.z) == sample.acceleration
    assert (r.x, r.y, r.z) == sample.angular_rate
    assert (q.x, q.y, q.z, q.w) == (sample.orientation if oriented else (0.0, 0.0, 0.0, 1.0))
    assert list(message.orientation_covariance) == [0.0 if oriented else -1.0, *[0.0] * 8]
    assert list(message.linear_acceleration_covariance) == [0.0] * 9


def test_mcap_decodes_it_with_its_crcs_on(bag: Path, namespace: str) -> None:
    with bag.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found: dict[str, list[Any]] = {}
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            assert message.log_time >= START_NS
            found.setdefault(channel.topic, []).append(decoded)
    for wrench, item in zip(found[topic(namespace, "wrench")], NEW[:2], strict=True):
        check_wrench(wrench, item, namespace)
    for imu, item in zip(found[topic(namespace, "imu/data_raw")], NEW, strict=True):
        check_imu(imu, item, namespace)
    (imu,) = found[topic(namespace, "imu/data")]
    check_imu(imu, FRAMES[3], namespace, oriented=True)
    assert [t.temperature for t in found[topic(namespace, "temperature")]] == [35.5] * 3
    raw = found[frame_topic(0)]
    assert [(r.sequence, r.stamp_ns, r.monotonic_ns, r.sensor, r.flags, r.wkc) for r in raw] == [
        item[:6] for item in FRAMES
    ]
    assert [bytes(r.process_data) for r in raw] == [item.process_data for item in FRAMES]


def test_the_whole_file_has_a_crc(bag: Path) -> None:
    with bag.open("rb") as file:
        assert sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages()) > len(FRAMES)


def test_rosbags_opens_it_and_finds_the_same(bag: Path, namespace: str) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert counts[topic(namespace, "wrench")] == 2
        assert counts[topic(namespace, "imu/data_raw")] == counts[topic(namespace, "temperature")] == 3
        assert counts[frame_topic(0)] == len(FRAMES)
        for connection in reader.connections:
            if connection.msgtype == FRAME_SCHEMA:
                store.register(get_types_from_msg(connection.msgdef.data, FRAME_SCHEMA))
        found: dict[str, list[Any]] = {}
        for connection, _, body in reader.messages():
            found.setdefault(connection.topic, []).append(
                store.deserialize_cdr(bytes(body), connection.msgtype)
            )
    for wrench, item in zip(found[topic(namespace, "wrench")], NEW[:2], strict=True):
        check_wrench(wrench, item, namespace)
    for imu, item in zip(found[topic(namespace, "imu/data_raw")], NEW, strict=True):
        check_imu(imu, item, namespace)
    (imu,) = found[topic(namespace, "imu/data")]
    check_imu(imu, FRAMES[3], namespace, oriented=True)
    assert [bytes(message.process_data) for message in found[frame_topic(0)]] == [
        item.process_data for item in FRAMES
    ]


def test_definitions_are_those_of_ros() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        for found, fields in get_types_from_msg(text, name).items():
            assert fields[1] == store.fielddefs[found][1], found


def test_units_of_the_firmware_are_followed() -> None:
    topics = RosTopics(imu_units=ImuUnits.SI)
    _, body = list(topics.messages(frame(0, **VALUES)))[1]
    expected = struct.unpack("<f", struct.pack("<f", 0.99))[0]
    assert struct.pack("<d", expected) in body


def test_a_time_that_ros_has_no_room_for_makes_no_message() -> None:
    assert not list(RosTopics().messages(frame(0)._replace(stamp_ns=2**64 - 1)))
