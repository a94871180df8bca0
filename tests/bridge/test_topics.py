"""The typed topics: values, units, frames, stamps, covariances; nothing that is not finite.

By DDS: frames and the filter themselves are tested in `test_outputs`.
"""

from __future__ import annotations

import itertools
import math
import queue
import time
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Imu, Temperature

from protocol.pdo import encode
from tests.bridge.conftest import PATIENCE_S, Listener, NodeThread, establish, starter, wait_until
from tests.bridge.scripted_server import ScriptedServer, process_data
from tests.bridge.shared import listener, server
from tests.bridge.streaming import Diagnostics

__all__ = ["listener", "server"]
pytestmark = pytest.mark.ros
_NUMBERS = itertools.count(1000)
QUATERNION = {"orientation.x": 0.5, "orientation.y": -0.5, "orientation.z": 0.5, "orientation.w": 0.5}


class Topics:
    """Subscriptions to the typed topics."""

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self.wrench = listener.subscribe(WrenchStamped, "wrench")
        self.imu = listener.subscribe(Imu, "imu/data_raw")
        self.oriented = listener.subscribe(Imu, "imu/data")
        self.temperature = listener.subscribe(Temperature, "temperature")


@pytest.fixture(scope="module")
def node(server: ScriptedServer, listener: Listener) -> Iterator[NodeThread]:
    with starter(listener) as start:
        yield start(
            server.port,
            frame_id="left_ft",
            imu_frame_id="left_imu",
            orientation_covariance="[0.1, 0.2, 0.3]",
            linear_acceleration_covariance="[1, 2, 3, 4, 5, 6, 7, 8, 9]",
            temperature_variance=0.25,
            wrench_frames="[tcp 0 0 0.5]",
            **{"filter.cutoff": 10.0},
            **{f"qos_overrides./{listener.tag}/wrench.publisher.reliability": "best_effort"},
        )


@pytest.fixture(scope="module")
def topics(server: ScriptedServer, listener: Listener, node: NodeThread) -> Topics:
    subscribed = Topics(listener)
    establish(server, listener)
    wait_until(
        lambda: (
            _sent(server)
            and not any(m.empty() for m in (subscribed.imu, subscribed.oriented, subscribed.temperature))
        ),
        "a message on every topic",
    )
    return subscribed


def _sent(server: ScriptedServer) -> bool:
    server.send_sample(0, process_data=encode(77, QUATERNION))
    server.send_sample(-1.0)
    return True


@pytest.fixture(autouse=True)
def _quiet(topics: Topics, server: ScriptedServer, node: NodeThread) -> Iterator[None]:
    # What was sent before is on its way for as long as it takes: wait for one that is known.
    number = float(next(_NUMBERS))
    marked = encode(61, {"acceleration.x": number, "temperature": number})
    server.send_sample(0, process_data=marked)
    while get(topics.temperature).temperature != number:
        pass
    while get(topics.imu).linear_acceleration.x != pytest.approx(number * 9.80665):
        pass
    yield
    assert node.is_running
    assert "Traceback" not in node.log


def get(messages: queue.Queue[Any]) -> Any:
    return messages.get(timeout=PATIENCE_S)


def vector(message: Any) -> tuple[float, float, float]:
    return message.x, message.y, message.z


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def test_a_topic_with_qos_of_the_users_own(topics: Topics, listener: Listener) -> None:
    """A reliable subscriber gets nothing from the wrench topic, which was made best effort."""
    (publisher,) = listener.node.get_publishers_info_by_topic(f"/{listener.tag}/wrench")
    assert publisher.qos_profile.reliability.name == "BEST_EFFORT"
    (publisher,) = listener.node.get_publishers_info_by_topic(f"/{listener.tag}/temperature")
    assert publisher.qos_profile.reliability.name == "RELIABLE"


def test_wrench(server: ScriptedServer, listener: Listener) -> None:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    messages: queue.Queue[Any] = queue.Queue()
    profile = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    listener.node.create_subscription(WrenchStamped, f"/{listener.tag}/wrench", messages.put, profile)
    stamp = 1_234_567_890_123_456_789

    def sent() -> bool:
        server.send_sample(7.0, stamp_ns=stamp)
        return True

    wait_until(lambda: sent() and not messages.empty(), "a wrench")
    message = get(messages)
    assert vector(message.wrench.force) == (7.0, 7.0625, 7.125)
    assert vector(message.wrench.torque) == (7.1875, 7.25, 7.3125)
    assert message.header.frame_id == "left_ft"
    assert stamp_ns(message) == stamp


def test_imu_in_si_units_and_without_orientation(server: ScriptedServer, topics: Topics) -> None:
    server.send_sample(2.0, stamp_ns=5_000_000_007)
    message = get(topics.imu)
    raw = [2.0 + i / 16 for i in range(12)]
    assert vector(message.linear_acceleration) == pytest.approx([v * 9.80665 for v in raw[6:9]])
    assert vector(message.angular_velocity) == pytest.approx([math.radians(v) for v in raw[9:]])
    assert message.header.frame_id == "left_imu"
    assert stamp_ns(message) == 5_000_000_007
    assert message.orientation_covariance[0] == -1.0
    assert list(message.linear_acceleration_covariance) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    assert list(message.angular_velocity_covariance) == [0.0] * 9


def test_orientation_where_the_sensor_estimates_one(server: ScriptedServer, topics: Topics) -> None:
    while not topics.oriented.empty():
        topics.oriented.get()
    acceleration = {"acceleration.z": 0.5}
    server.send_sample(0, process_data=encode(77, QUATERNION | acceleration), stamp_ns=7)
    server.send_sample(0, process_data=process_data(1.0, 77))  # all zero: no estimate
    server.send_sample(0, process_data=process_data(1.0, 61))
    server.send_sample(0, process_data=encode(77, QUATERNION), stamp_ns=9)
    messages = [get(topics.oriented) for _ in range(2)]
    assert [stamp_ns(message) for message in messages] == [7, 9]
    for message in messages:
        q = message.orientation
        assert (q.x, q.y, q.z, q.w) == (0.5, -0.5, 0.5, 0.5)
        assert list(message.orientation_covariance) == [0.1, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.3]
        assert message.header.frame_id == "left_imu"
    assert messages[0].linear_acceleration.z == pytest.approx(0.5 * 9.80665)
    for raw in (get(topics.imu) for _ in range(4)):
        assert raw.orientation_covariance[0] == -1.0
        assert raw.orientation.w == 1.0


def test_outputs_that_are_configured(server: ScriptedServer, topics: Topics, listener: Listener) -> None:
    by_name = {
        name: listener.subscribe(WrenchStamped, name)
        for name in ("wrench_compensated/tcp", "wrench_filtered")
    }
    wait_until(lambda: _sent(server) and not any(m.empty() for m in by_name.values()), "messages")
    frames = {name: get(messages).header.frame_id for name, messages in by_name.items()}
    assert frames == {"wrench_compensated/tcp": "tcp", "wrench_filtered": "left_ft"}


def test_temperature(server: ScriptedServer, topics: Topics) -> None:
    server.send_sample(0, process_data=encode(61, {"temperature": 36.5}), stamp_ns=42)
    message = get(topics.temperature)
    assert (message.temperature, message.variance, stamp_ns(message)) == (36.5, 0.25, 42)
    assert message.header.frame_id == "left_ft"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_stays_away_from_its_topic(
    server: ScriptedServer, topics: Topics, listener: Listener, value: float
) -> None:
    server.send_sample(0, process_data=encode(61, {"temperature": value, "force.x": 1.0}))
    server.send_sample(0, process_data=encode(77, {"orientation.x": value, "temperature": 2.0}))
    server.send_sample(0, process_data=encode(61, {"force.x": value, "temperature": 3.0}))
    server.send_sample(0, process_data=encode(61, {"acceleration.z": 4.0, "temperature": 4.0}))
    assert [get(topics.temperature).temperature for _ in range(3)] == [2.0, 3.0, 4.0]
    got = [get(topics.imu).linear_acceleration.z for _ in range(4)]
    assert got == pytest.approx([0.0, 0.0, 0.0, 4.0 * 9.80665])


def test_a_late_subscriber_gets_only_what_is_new(
    server: ScriptedServer, topics: Topics, listener: Listener
) -> None:
    for number in range(50):
        server.send_sample(float(number))
    while get(topics.imu).linear_acceleration.x != pytest.approx((49 + 6 / 16) * 9.80665):
        pass
    late = listener.subscribe(Imu, "imu/data_raw")
    began_ns = time.time_ns()
    wait_until(lambda: _sent(server) and not late.empty(), "a message for the late subscriber")
    assert stamp_ns(get(late)) > began_ns


def test_parameters_services_and_what_follows_from_them(
    server: ScriptedServer, topics: Topics, listener: Listener
) -> None:
    """By ROS's own means; what they do is tested in simulated time."""
    from rcl_interfaces.srv import DescribeParameters

    bias = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    compensated = listener.subscribe(WrenchStamped, "wrench_compensated")
    assert listener.set_parameter("bias_ramp_time", 0.0) == (True, "")
    assert listener.set_parameter("bias", bias) == (True, "")
    assert list(listener.parameters("bias")[0]) == bias
    done, reason = listener.set_parameter("tool_mass", -1.0)
    assert not done
    assert "tool_mass" in reason
    wait_until(lambda: _sent(server) and not compensated.empty(), "wrench_compensated")
    while vector(get(compensated).wrench.force) != (-2.0, -2.9375, -3.875):
        server.send_sample(-1.0)
    assert listener.trigger("clear_tare") == (True, "the bias is zero")
    assert list(listener.parameters("bias")[0]) == [0.0] * 6
    request = DescribeParameters.Request(names=["settings.sinc_length"])
    (described,) = listener.call(DescribeParameters, "describe_parameters", request).descriptors
    assert described.description
    assert set(Diagnostics(listener).next()) == {"link", "stream", "sensor", "clock", "compensation"}
