"""A recording as ROS topics has the numbers of the Parquet export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from pyarrow import parquet
from rosbags.highlevel import AnyReader

from bota_clients.export.cli import main
from bota_clients.export.ros_topics import TOPICS
from bota_ft_compensation.identification.parameter_file import write_payload
from tests.bridge.test_one_stream import recorded
from tests.compensation.making import BIAS, TOOL
from tests.corpus import OFFSET, STREAMS
from tests.ended import run_here


def numbers(message: Any, name: str) -> list[float]:
    if name == "temperature":
        return [message.temperature]
    if name.startswith("imu"):
        parts = message.angular_velocity, message.linear_acceleration
    else:
        parts = message.wrench.force, message.wrench.torque
    return [getattr(part, axis) for part in parts for axis in "xyz"]


@pytest.mark.parametrize("has_tool", [True, False])
@pytest.mark.parametrize(
    "name", ["gaps", "not_finite", "lost_and_back", "offset_written", "larger_process_data"]
)
def test_every_number_is_that_of_the_table(name: str, has_tool: bool, tmp_path: Path) -> None:
    run, bag, table = (tmp_path / each for each in ("run.mcap", "ros.mcap", "t.parquet"))
    recorded(STREAMS[name], run)
    tool = tmp_path / "tool.yaml"
    write_payload(tool, TOOL, "", [("bias", BIAS.values, ""), ("sensor_offset", OFFSET, "")])
    more = ["--sensor", 0, *(["--tool", tool] if has_tool else [])]
    assert run_here(main, run, table, *more).code == 0
    ended = run_here(main, run, "--ros", bag, *more)
    assert (ended.code, "on wrench, " in ended.err) == (0, True)
    expected = parquet.read_table(table)
    stamps = expected["stamp_utc"].to_numpy().astype(np.int64)
    found: dict[str, list[tuple[int, list[float]]]] = {}
    with AnyReader([bag]) as reader:
        kinds = {each.topic[1:]: each.msgtype for each in reader.connections}
        for connection, stamp_ns, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            name, header = connection.topic[1:], message.header
            assert stamp_ns == header.stamp.sec * 10**9 + header.stamp.nanosec
            assert header.frame_id == ("ft_sensor_imu" if "imu" in name else "ft_sensor")
            found.setdefault(name, []).append((stamp_ns, numbers(message, name)))
    for topic in TOPICS:
        if topic.valid and not has_tool:
            assert topic.name not in kinds
            continue
        values = np.stack([expected[column].to_numpy() for column in topic.columns], axis=1).astype(float)
        known = np.isfinite(values).all(axis=1)
        if topic.valid:
            known &= expected[topic.valid].to_numpy()
        rows = found[topic.name]
        assert kinds[topic.name] == topic.kind
        assert [stamp for stamp, _ in rows] == stamps[known].tolist()
        assert np.array([each for _, each in rows]).tobytes() == values[known].tobytes()
        assert 0 < len(rows) <= len(stamps)


def test_definitions_are_those_of_ros_2_and_an_imu_has_no_orientation(tmp_path: Path) -> None:
    run, bag = recorded(STREAMS["plain"], tmp_path / "run.mcap"), tmp_path / "ros.mcap"
    assert run_here(main, run, "--ros", bag).code == 0
    assert "exists" in run_here(main, run, "--ros", bag).err
    with bag.open("rb") as file:
        summary = make_reader(file).get_summary()
    for schema in summary.schemas.values() if summary else ():
        assert "\nMSG: builtin_interfaces/Time\n" in schema.data.decode()
    with AnyReader([bag]) as reader:
        (imu,) = (each for each in reader.connections if each.topic == "/imu/data_raw")
        _, _, data = next(reader.messages([imu]))
        message: Any = reader.deserialize(data, imu.msgtype)
    assert message.orientation_covariance.tolist() == [-1.0, *[0.0] * 8]
    refused = run_here(main, run, "--ros", bag, "--fps", 30)
    assert (refused.code, "--ros writes all samples: omit" in refused.err) == (2, True)
