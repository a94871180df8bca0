"""Orientation from a topic and from TF: taken, refused, stale, back again. In simulated time."""

from __future__ import annotations

import itertools
import math
import re
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped, QuaternionStamped
from sensor_msgs.msg import Imu

from bota_ethercat.pdo import STANDARD_GRAVITY
from bota_ethercat.replies import SensorInfo
from bota_ethercat.settings import SettingValue
from bota_ethercat.stream.timeline import InForce
from bota_ethercat_bridge.compensating.sources import RobotSource
from bota_ethercat_bridge.node import StartError
from bota_ft_compensation.imu import ImuSource
from tests.bridge.fake_tf import FakeTf
from tests.bridge.simulated_node import (
    DEFAULTS,
    OVER,
    QUICK,
    SIDE,
    UP,
    ZERO6,
    Node,
    Server,
    Stages,
    is_near,
    values,
    weight,
)
from tests.compensation.making import BIAS, TOOL, sample
from tests.server.running import wait_until

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ROLLED = (1.0, 0.0, 0.0, 0.0)  # half a turn about x: what was up is down
# A quarter of a turn about -y: the sensor's x axis points up.
TILTED = (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))
POSE: dict[str, Any] = {
    "tool_mass": TOOL.mass,
    "tool_center_of_gravity": [*TOOL.center],
    "gravity_source": "topic_pose",
    "orientation.topic": "arm/pose",
    "orientation.stale_after": 0.5,
    **QUICK,
}


class Robot(Server):
    """Publishes an orientation ten times a simulated second, to whatever the node listens to."""

    def __init__(self) -> None:
        super().__init__()
        self.node: Any = None
        self.restore()

    def restore(self) -> None:
        self.quaternion, self.offset_s, self.stamped, self.sending = UPRIGHT, 0.0, True, True
        self.hold(UP, acceleration_x=0.1)  # the sensor's own accelerometer says something else

    def listening(self) -> list[Any]:
        """The node's subscriptions to topics of the arm."""
        return [each for each in self.node.subscriptions if "/arm/" in each.topic_name] if self.node else []

    def step(self) -> None:
        super().step()
        for subscription in self.listening() if self.sending and self.sent % 10 == 0 else ():
            message = subscription.msg_type()
            if self.stamped:
                stamp = message.header.stamp
                stamp.sec, stamp.nanosec = divmod(self.time_ns() + int(self.offset_s * 1e9), 10**9)
            holder = message.pose if isinstance(message, PoseStamped) else message
            q = holder.quaternion if isinstance(message, QuaternionStamped) else holder.orientation
            q.x, q.y, q.z, q.w = self.quaternion
            subscription.callback(message)


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.fixture
def node(robot: Robot) -> Iterator[Node]:
    with Node(robot, **POSE) as started:
        robot.node = started.node
        yield started


@pytest.fixture
def stages(node: Node) -> Stages:
    stages = Stages(node)
    stages.settle(ZERO6)
    return stages


def test_gravity_that_the_accelerometer_contradicts_at_rest_is_a_warning(
    robot: Robot, stages: Stages, node: Node
) -> None:
    """The base is upside down, and so 16 N are wrong; compensation goes on."""
    assert values(node.until(compensation="ok")["compensation"])
    robot.quaternion = ROLLED
    node.run(4.0)
    told = node.until(compensation="warn")["compensation"]
    assert re.search("is 17[0-9]° from the accelerometer's: check the signs", told.message)
    assert node.log.count("wrench_compensated is wrong: gravity by the robot's orientation is 17") == 1
    robot.quaternion = UPRIGHT
    node.run(4.0)
    node.until(compensation="ok")


@pytest.mark.parametrize(
    ("source", "message_type"),
    [("topic_quaternion", QuaternionStamped), ("topic_imu", Imu), ("topic_pose", PoseStamped)],
)
def test_each_message_type(robot: Robot, stages: Stages, node: Node, source: str, message_type: Any) -> None:
    node.set("orientation.topic", f"arm/{source}")
    node.set("gravity_source", source)
    (subscription,) = robot.listening()
    assert subscription.msg_type is message_type
    assert subscription.callback_group is not node.node.default_callback_group, "it waits for no service"
    for quaternion, up in ((UPRIGHT, UP), (ROLLED, OVER), (TILTED, SIDE)):
        robot.quaternion = quaternion
        stages.at(up, acceleration_y=3.0)


def test_a_source_that_falls_silent_and_comes_back(robot: Robot, stages: Stages, node: Node) -> None:
    node.until(compensation="ok")
    measured = node.hear("wrench")
    robot.sending = False
    node.run(0.3)
    assert not stages.are_silent(), "the last one holds for half a second"
    node.until("older than the sample (limit 0.5 s, ", "it has stopped", compensation="error")
    assert stages.are_silent()
    robot.quaternion = ROLLED  # it has moved in the meantime
    robot.hold(OVER)
    node.run(0.2)
    assert is_near(measured[-1], weight(OVER))
    robot.sending = True
    stages.forget()
    assert stages.first() == pytest.approx(ZERO6, abs=1e-3)  # never with the old pose
    node.until(" samples were not compensated: no current orientation (topic ", compensation="warn")
    node.until(compensation="ok")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ({"stamped": False}, "its messages have no time stamp"),
        ({"offset_s": -30.0}, "is 30 s older than the sample (limit 0.5 s"),
        (
            {"offset_s": 30.0},
            "s newer than the sample (limit 0.5 s, ",
        ),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "a quaternion of length 1, this one's is 0"),
        ({"quaternion": (0.0, math.nan, 0.0, 1.0)}, "a quaternion of length 1, this one's is nan"),
    ],
)
def test_what_is_refused(robot: Robot, stages: Stages, node: Node, spoil: dict[str, Any], words: str) -> None:
    for name, value in spoil.items():
        setattr(robot, name, value)
    node.until(words, compensation="error")
    assert stages.are_silent()
    robot.restore()
    stages.settle(ZERO6)
    node.until(compensation="ok")


def test_an_imu_without_orientation(robot: Robot, stages: Stages, node: Node) -> None:
    robot.sending = False
    node.set("orientation.topic", "arm/imu")
    node.set("gravity_source", "topic_imu")
    message = Imu()
    message.orientation_covariance[0] = -1.0
    robot.listening()[0].callback(message)
    topic = node.name.replace("bridge", "arm/imu")
    node.until(
        f"no orientation from topic {topic}: its messages say that they have none", compensation="error"
    )
    robot.sending = True
    stages.settle(ZERO6)


def test_an_orientation_of_another_type_is_named(robot: Robot, stages: Stages, node: Node) -> None:
    """A participant of its own: in one process a topic has one type."""
    robot.sending = False
    topic = node.name.replace("bridge", "arm/other")
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    try:
        other = rclpy.create_node("arm", context=context, start_parameter_services=False)
        other.create_publisher(Imu, topic, 1)
        wait_until(lambda: node.node.count_publishers(topic), "the other's publisher")
        node.set("orientation.topic", "arm/other")
        words = "its publisher sends sensor_msgs/msg/Imu, not geometry_msgs/msg/PoseStamped: set "
        node.until(words + "gravity_source to topic_imu", compensation="error")
        assert stages.are_silent()
        other.destroy_node()
    finally:
        rclpy.shutdown(context=context)


def test_what_is_mounted_askew(robot: Robot, stages: Stages, node: Node) -> None:
    """The arm hangs down and the sensor is turned about its own z axis in it; then the base."""
    robot.quaternion = TILTED  # the arm's x axis points up; that is the sensor's -y
    robot.hold((0, -1, 0))
    node.set("orientation.mounting", [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)])
    stages.settle(ZERO6)
    robot.restore()
    robot.hold(SIDE)
    node.set("orientation.mounting", [0, 0, 0, 1])
    node.set("gravity", [-9.80665, 0.0, 0.0])
    stages.settle(ZERO6)


def test_a_tare_goes_by_the_topic(robot: Robot, stages: Stages, node: Node) -> None:
    robot.quaternion = ROLLED
    stages.at(OVER, bias=BIAS, acceleration_x=0.3, wanted=list(BIAS.values))
    node.do("tare")
    stages.settle(ZERO6)
    robot.quaternion = TILTED
    stages.at(SIDE, bias=BIAS)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("orientation.topic", "no such name!", "'no such name!': topic name must not contain"),
        ("gravity_source", "tf", "sudo apt install ros-$ROS_DISTRO-tf2-ros-py and source ROS 2, or take"),
    ],
)
def test_a_source_that_cannot_be_had(
    stages: Stages, node: Node, monkeypatch: pytest.MonkeyPatch, name: str, value: str, words: str
) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    before = node.parameters(name)
    node.refuse_value(name, value, words)
    assert node.parameters(name) == before
    stages.settle(ZERO6)
    if value == "tf":
        with pytest.raises(StartError, match="parameter gravity_source is 'tf': it needs tf2_ros"):
            Node(Server(), gravity_source="tf")


def test_nothing_listens_where_no_source_is_chosen(robot: Robot, stages: Stages, node: Node) -> None:
    assert robot.listening()
    node.set("gravity_source", "imu")
    assert not robot.listening()
    stages.at(UP)
    assert values(node.until(compensation="ok")["compensation"])["gravity_source"] == "imu"


# TF.


def test_the_source_tf(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    tf = FakeTf(monkeypatch)
    given = POSE | {"gravity_source": "tf", "orientation.base_frame": "world", "frame_id": "ft"}
    # The frames say all, so `mounting` is not for TF.
    with Node(robot, **given | {"orientation.mounting": [*ROLLED]}) as node:
        stages = Stages(node)
        words = "no orientation from TF from world to ft: TF has no pose of ft in world: frame does not exist"
        node.until(words, compensation="error")
        assert set(tf.asked) == {("world", "ft")}
        assert not any(stages.all)
        tf.quaternion, tf.newest_ns, tf.error = TILTED, robot.time_ns, None
        stages.at(SIDE)
        tf.error = "the tree fell apart"
        node.until("older than the sample (limit 0.5 s, ", "the tree fell apart", compensation="error")
        assert stages.are_silent()
        tf.error = None
        stages.settle(ZERO6)
        tf.newest_ns = lambda: 0  # static transforms only: they hold at any time
        monkeypatch.setattr(time, "time_ns", robot.time_ns)
        node.run(1.0)
        stages.settle(ZERO6)
        assert tf.listening == 1
        node.set("gravity_source", "imu")
        assert tf.listening == 0
        assert not list(node.node.timers)


# Time that goes back, and rotations.


def test_the_imu_is_delayed_as_the_filters_that_are_set_delay_force_and_torque() -> None:
    source, number = ImuSource(), itertools.count(1)

    def felt(count: int = 1) -> float:
        found = None
        for at in itertools.islice(number, count):
            found = source.specific_force(sample(acceleration=(float(at), 0.0, 9.8)), at / 100, 0.0)
        assert found is not None
        return found[0]

    assert felt() == 1.0, "nothing is known of them"
    known: dict[str, SettingValue] = {"sinc_length": 512, "fir": False, "acceleration_filter": 1}
    source.configure(InForce(SensorInfo(settings=known, rate_hz=100)))
    assert felt(20) == pytest.approx(21 - (15 - 1.94) / 10)
    source.configure(InForce(SensorInfo(settings={**known, "chop": True}, rate_hz=100)))
    assert felt() == 22.0, "how long CHOP delays is not known"
    for rate_hz in (100, 50):
        source.configure(InForce(SensorInfo(settings=known, rate_hz=rate_hz)))
    assert source._imu.alignment.period_s == 0.02, "the same filters at another rate"


@pytest.mark.parametrize("set_by_s", [0.0, -3600.0, -0.05, 0.05, 3600.0])
def test_an_orientation_of_a_topic_is_carried_on_to_the_sample(set_by_s: float) -> None:
    """The robot turns by 2 rad/s about x and tells its pose 20 ms late, twenty times a second; meanwhile the
    wall clock, by which poses are stamped, is set."""
    source, speed, begin_s, wall_s = RobotSource(DEFAULTS, "topic /pose"), 2.0, 1000.0, 1e9
    for step in range(100):
        t = step * 0.01
        if step == 50:
            wall_s += set_by_s
        if step % 5 == 2:
            half = 0.5 * speed * (t - 0.02)
            stamp_ns = round((wall_s + t - 0.02) * 1e9)
            source.latest = (math.sin(half), 0.0, 0.0, math.cos(half)), stamp_ns
        got = source.specific_force(sample(angular_rate=(speed, 0.0, 0.0)), begin_s + t, wall_s + t)
        if step > 2:
            wanted = 0.0, STANDARD_GRAVITY * math.sin(speed * t), STANDARD_GRAVITY * math.cos(speed * t)
            assert got == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "given", "lever"),
    [
        ("BFT-SENS-ECAT-M8", (0.0, 0.0, 0.0), (0.01, 0.02, 0.03 + 0.0257)),
        ("BFT-MEGS-ECAT-M8", (0.0, 0.0, 0.0), (0.01, 0.02, 0.03 + 0.0456)),
        ("another", (0.0, 0.0, 0.0), (0.01, 0.02, 0.03)),
        ("BFT-SENS-ECAT-M8", (0.001, 0.0, 0.002), (0.009, 0.02, 0.028)),
    ],
)
def test_the_lever_of_the_imu_is_that_of_the_model_or_as_given(
    name: str, given: tuple[float, float, float], lever: tuple[float, float, float]
) -> None:
    """Of a sensor that turns at 10 rad/s about an axis between its own."""
    source, rate = ImuSource((0.01, 0.02, 0.03), given), (6.0, -8.0, 4.0)
    source.configure(InForce(SensorInfo(name=name, settings={}, rate_hz=800.0)))
    spun = sample(acceleration=(1.0, 2.0, 9.0), angular_rate=rate)
    for number in range(40):
        found = source.specific_force(spun, number / 800.0, 0.0)
    outward = [
        sum(a * b for a, b in zip(rate, lever, strict=True)) * w - 116.0 * d
        for w, d in zip(rate, lever, strict=True)
    ]
    assert found == pytest.approx([1.0 + outward[0], 2.0 + outward[1], 9.0 + outward[2]])
    off = sample(acceleration=(0.0, 0.0, 0.0), angular_rate=rate)
    assert source.specific_force(off, 0.05, 0.0) is None
