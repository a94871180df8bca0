"""The topics in simulated time: values, units, frames, stamps, covariances; nothing that is not finite."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from bota_ethercat.pdo import encode
from tests.bridge.compensating import stamp_ns
from tests.bridge.scripted_server import process_data
from tests.bridge.simulated_node import STEP_S, SimulatedNode, SimulatedServer

pytestmark = pytest.mark.ros
QUATERNION = {"orientation.x": 0.5, "orientation.y": -0.5, "orientation.z": 0.5, "orientation.w": 0.5}
RAW = [2.0 + i / 16 for i in range(12)]
"""What `process_data(2.0)` has."""
TOPICS = (
    "sensone_sensor_data", "wrench", "imu/data_raw", "imu/data", "temperature", "wrench_compensated/tcp",
    "wrench_filtered",
)  # fmt: skip


class Published:
    """What the node makes of single samples."""

    def __init__(self, node: SimulatedNode, server: SimulatedServer) -> None:
        self._node, self._server = node, server
        self.topics = {name: node.hear(name) for name in TOPICS}
        node.run(0.2)

    def of(self, *samples: dict[str, Any]) -> dict[str, list[Any]]:
        """The messages of these, by topic."""
        for messages in self.topics.values():
            messages.clear()
        for sample in samples:
            self._server.once(**sample)
        self._node.run(len(samples) * STEP_S)
        return self.topics


@pytest.fixture(scope="module")
def published(_ros: None) -> Iterator[Published]:
    server = SimulatedServer()
    with SimulatedNode(
        server,
        frame_id="left_ft",
        imu_frame_id="left_imu",
        orientation_covariance="[0.1, 0.2, 0.3]",
        linear_acceleration_covariance="[1, 2, 3, 4, 5, 6, 7, 8, 9]",
        temperature_variance=0.25,
        wrench_frames="[tcp 0 0 0.5]",
        **{"filter.cutoff": 10.0},
    ) as node:
        yield Published(node, server)


def vector(message: Any) -> tuple[float, float, float]:
    return message.x, message.y, message.z


def test_every_topic_of_one_sample(published: Published) -> None:
    stamp = 1_234_567_890_123_456_789
    heard = published.of({"process_data": process_data(2.0), "stamp_ns": stamp})
    one = {name: messages[0] for name, messages in heard.items() if messages}
    assert one.keys() == {*TOPICS} - {"imu/data"}, "there is no orientation"
    array, wrench, imu = one["sensone_sensor_data"], one["wrench"], one["imu/data_raw"]
    si = [*RAW[:6], *(v * 9.80665 for v in RAW[6:9]), *(math.radians(v) for v in RAW[9:])]
    assert list(array.data) == pytest.approx(si, rel=1e-12)
    (dimension,) = array.layout.dim
    assert dimension.label == "Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz"
    assert (dimension.size, dimension.stride, array.layout.data_offset) == (12, 12, 0)
    assert [*vector(wrench.wrench.force), *vector(wrench.wrench.torque)] == RAW[:6]
    assert vector(imu.linear_acceleration) == pytest.approx(si[6:9])
    assert vector(imu.angular_velocity) == pytest.approx(si[9:])
    assert imu.orientation_covariance[0] == -1.0
    assert list(imu.linear_acceleration_covariance) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    assert list(imu.angular_velocity_covariance) == [0.0] * 9
    del one["sensone_sensor_data"]
    assert {stamp_ns(message) for message in one.values()} == {stamp}
    assert {name: message.header.frame_id for name, message in one.items()} == {
        "wrench": "left_ft", "imu/data_raw": "left_imu", "temperature": "left_ft",
        "wrench_compensated/tcp": "tcp", "wrench_filtered": "left_ft",
    }  # fmt: skip


def test_orientation_where_the_sensor_estimates_one(published: Published) -> None:
    heard = published.of(
        {"process_data": encode(77, QUATERNION | {"acceleration.z": 0.5}), "stamp_ns": 7},
        {"process_data": encode(77, {"force.x": 1.0})},  # no estimate
        {"process_data": process_data(1.0, 61)},
        {"process_data": encode(77, QUATERNION), "stamp_ns": 9},
    )
    oriented, raw = heard["imu/data"], heard["imu/data_raw"]
    assert [stamp_ns(message) for message in oriented] == [7, 9]
    for message in oriented:
        q = message.orientation
        assert (q.x, q.y, q.z, q.w) == (0.5, -0.5, 0.5, 0.5)
        assert list(message.orientation_covariance) == [0.1, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.3]
        assert message.header.frame_id == "left_imu"
    assert oriented[0].linear_acceleration.z == pytest.approx(0.5 * 9.80665)
    assert [(m.orientation_covariance[0], m.orientation.w) for m in raw] == [(-1.0, 1.0)] * 4


def test_temperature(published: Published) -> None:
    heard = published.of({"process_data": encode(61, {"temperature": 36.5})})
    (message,) = heard["temperature"]
    assert (message.temperature, message.variance) == (36.5, 0.25)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_stays_away_from_its_topic(published: Published, value: float) -> None:
    heard = published.of(
        {"process_data": encode(61, {"temperature": value, "force.x": 1.0})},
        {"process_data": encode(77, {"orientation.x": value, "temperature": 2.0})},
        {"process_data": encode(61, {"force.x": value, "temperature": 3.0})},
        {"process_data": encode(61, {"acceleration.z": 4.0, "temperature": 4.0})},
    )
    assert [message.temperature for message in heard["temperature"]] == [2.0, 3.0, 4.0]
    assert [message.wrench.force.x for message in heard["wrench"]] == [1.0, 0.0, 0.0]
    got = [message.linear_acceleration.z for message in heard["imu/data_raw"]]
    assert got == pytest.approx([0.0, 0.0, 0.0, 4.0 * 9.80665])
    assert not heard["imu/data"]
