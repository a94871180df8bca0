"""Orientation from a topic and from TF: taken, refused, stale, back again. The node is in simulated time.

The topics are real, and so is the executor that listens to them.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

import rclpy
from geometry_msgs.msg import PoseStamped, Quaternion, QuaternionStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Imu

from bota_ethercat.text.json_text import JsonObject
from bridge.compensating.orientations import OrientationListener, multiply
from bridge.compensating.tool_sources import ListenerSource, Oriented
from bridge.node import StartError
from bridge.parameters.compensation import DEFAULTS
from bridge.parameters.row import ParameterError
from bridge.transforms import check_tf
from ft_compensation.quantities import length, unit_quaternion
from tests.bridge.compensating import OVER, QUICK, SIDE, UP, ZERO6, Stages, hold, is_near, weight
from tests.bridge.conftest import listening, retire
from tests.bridge.fake_tf import FakeTf
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer
from tests.bridge.streaming import values
from tests.compensation.making import BIAS, TOOL, sample
from tests.server.running import wait_until

pytestmark = pytest.mark.ros
OK, WARN, ERROR, STALE = range(4)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ROLLED = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x: what was up is down."""
TILTED = (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))
"""A quarter of a turn about -y: the sensor's x axis points up."""


class Robot(SimulatedServer):
    """Publishes an orientation ten times a simulated second, and waits until it is taken in."""

    def __init__(self) -> None:
        super().__init__()
        self.taken = threading.Event()
        self._node = rclpy.create_node("robot", start_parameter_services=False)
        self._publisher: Any = None
        self.restore()

    def use(self, message_type: Any, topic: str) -> None:
        """Publish on this topic from now on, and on no other."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
        self._publisher = self._node.create_publisher(message_type, topic, 10)

    def restore(self) -> None:
        self.quaternion, self.offset_s, self.stamped, self.sending = UPRIGHT, 0.0, True, True
        self.change: Callable[[Any], None] = lambda message: None
        # The sensor's own accelerometer says something else.
        hold(self, UP, acceleration_x=3.0)

    def close(self) -> None:
        retire(self._node)

    def step(self) -> None:
        super().step()
        if self.sending and self.sent % 10 == 0:
            self._send(self._publisher)

    def _send(self, publisher: Any) -> None:
        message = publisher.msg_type()
        if self.stamped:
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(self.time_ns() + int(self.offset_s * 1e9), 10**9)
        x, y, z, w = self.quaternion
        quaternion = Quaternion(x=x, y=y, z=z, w=w)
        if isinstance(message, PoseStamped):
            message.pose.orientation = quaternion
        elif isinstance(message, Imu):
            message.orientation = quaternion
        else:
            message.quaternion = quaternion
        self.change(message)
        self.taken.clear()
        publisher.publish(message)
        wait_until(lambda: self.taken.wait(0.1) or publisher.publish(message), "the orientation to be taken")


@pytest.fixture(scope="module")
def _robot(_ros: None) -> Iterator[Robot]:
    robot = Robot()
    take = OrientationListener._take

    def taken(self: OrientationListener, read: Callable[[], Oriented]) -> None:
        take(self, read)
        robot.taken.set()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OrientationListener, "_take", taken)
        yield robot
    robot.close()


@pytest.fixture(scope="module")
def node(_robot: Robot) -> Iterator[SimulatedNode]:
    given = {
        "tool_mass": TOOL.mass,
        "tool_center_of_gravity": [*TOOL.center],
        "gravity_source": "topic_pose",
        "orientation.topic": "arm/pose",
        "orientation.stale_after": 0.5,
    }
    with SimulatedNode(_robot, **QUICK, **given) as started, listening(started.node) as raised:
        yield started
        assert not raised


@pytest.fixture(scope="module")
def stages(node: SimulatedNode) -> Stages:
    return Stages(node)


def listen(node: SimulatedNode, source: str, topic: str) -> str:
    """Have the node listen there; the topic's whole name."""
    assert node.set_parameter("orientation.topic", topic) == (True, "")
    assert node.set_parameter("gravity_source", source) == (True, "")
    return node.name.replace("bridge", topic)


@pytest.fixture
def robot(_robot: Robot, node: SimulatedNode, stages: Stages) -> Robot:
    _robot.restore()
    _robot.use(PoseStamped, listen(node, "topic_pose", "arm/pose"))
    return _robot


def test_before_anything_has_come(robot: Robot, node: SimulatedNode) -> None:
    robot.sending = False
    topic = listen(node, "topic_pose", "arm/other")
    node.until(f"no orientation from topic {topic}: nothing has come", compensation=ERROR)
    done, text = node.trigger("tare")
    assert not done
    assert "nothing has come" in text


@pytest.mark.parametrize(
    ("source", "message_type"),
    [("topic_quaternion", QuaternionStamped), ("topic_imu", Imu), ("topic_pose", PoseStamped)],
)
def test_each_kind_of_message(
    robot: Robot, stages: Stages, node: SimulatedNode, source: str, message_type: Any
) -> None:
    robot.use(message_type, listen(node, source, f"arm/{source}"))
    for quaternion, up in ((UPRIGHT, UP), (ROLLED, OVER), (TILTED, SIDE)):
        robot.quaternion = quaternion
        hold(robot, up, acceleration_y=3.0)
        stages.settle(ZERO6)


def test_a_source_that_falls_silent_and_comes_back(robot: Robot, stages: Stages, node: SimulatedNode) -> None:
    stages.settle(ZERO6)
    node.until(compensation=OK)
    measured = node.hear("wrench")
    robot.sending = False
    node.run(0.3)
    assert not stages.are_silent(), "the last one holds for half a second"
    node.until("older than the sample (limit 0.5 s): it has stopped", compensation=ERROR)
    assert stages.are_silent()
    robot.quaternion = ROLLED  # it has moved in the meantime
    hold(robot, OVER)
    node.run(0.2)
    assert is_near(measured[-1], weight(OVER))
    robot.sending = True
    stages.forget()
    assert stages.first() == pytest.approx(ZERO6, abs=1e-3)  # never with the old pose
    node.until(compensation=OK)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ({"stamped": False}, "its messages have no time stamp"),
        (
            {"offset_s": -30.0},
            "older than the sample (limit 0.5 s): it has stopped, is slow, or has another clock",
        ),
        ({"offset_s": 30.0}, "after the sample (limit 0.5 s): the clocks of the two computers differ"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "a quaternion of length 1, this one's is 0"),
        ({"quaternion": (0.0, math.nan, 0.0, 1.0)}, "a quaternion of length 1, this one's is nan"),
    ],
)
def test_what_cannot_be_used(
    robot: Robot, stages: Stages, node: SimulatedNode, spoil: dict[str, Any], words: str
) -> None:
    stages.settle(ZERO6)
    for name, value in spoil.items():
        setattr(robot, name, value)
    node.until(words, compensation=ERROR)
    assert stages.are_silent()
    robot.restore()
    stages.settle(ZERO6)
    node.until(compensation=OK)


def test_an_imu_without_orientation(robot: Robot, stages: Stages, node: SimulatedNode) -> None:
    topic = listen(node, "topic_imu", "arm/imu")

    def unknown(message: Any) -> None:
        message.orientation_covariance[0] = -1.0

    robot.change = unknown
    robot.use(Imu, topic)
    node.until(f"no orientation from topic {topic}: its messages say that they have none", compensation=ERROR)
    robot.restore()
    stages.settle(ZERO6)


def test_a_sensor_mounted_askew(robot: Robot, stages: Stages, node: SimulatedNode) -> None:
    """The arm hangs down and the sensor is turned about its own z axis in it."""
    quarter = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]
    robot.quaternion = TILTED  # the arm's x axis points up; that is the sensor's -y
    hold(robot, (0, -1, 0))
    assert node.set_parameter("orientation.mounting", quarter) == (True, "")
    stages.settle(ZERO6)
    assert node.set_parameter("orientation.mounting", [0, 0, 0, 1]) == (True, "")


def test_gravity_in_a_base_that_is_mounted_askew(robot: Robot, stages: Stages, node: SimulatedNode) -> None:
    hold(robot, SIDE)
    assert node.set_parameter("gravity", [-9.80665, 0.0, 0.0]) == (True, "")
    stages.settle(ZERO6)
    assert node.set_parameter("gravity", [0.0, 0.0, -9.80665]) == (True, "")


def test_a_tare_goes_by_the_topic(robot: Robot, stages: Stages, node: SimulatedNode) -> None:
    robot.quaternion = ROLLED
    hold(robot, OVER, bias=BIAS, acceleration_x=0.3)
    stages.settle(list(BIAS.values))
    done, text = node.trigger("tare")
    assert done, text
    stages.settle(ZERO6)
    robot.quaternion = TILTED
    hold(robot, SIDE, bias=BIAS)
    stages.settle(ZERO6)
    assert node.trigger("clear_tare")[0]


def test_the_orientation_is_taken_in_while_a_service_waits(
    robot: Robot, stages: Stages, node: SimulatedNode
) -> None:
    stages.settle(ZERO6)
    asked: list[JsonObject] = []
    robot.answers["tare"] = asked.append  # the reply is kept back

    def turn() -> None:
        robot.quaternion = ROLLED
        hold(robot, OVER)

    def reply() -> None:
        stages.settle(ZERO6)
        refused = {"ok": False, "error": {"code": "denied", "message": "no"}}
        robot.send_json({"reply": "tare", "id": asked[0]["id"], **refused})

    node.at(0.8, turn)  # longer than an orientation holds
    node.at(1.6, reply)
    assert node.trigger("sensor_tare") == (False, "no (denied)")
    assert is_near(stages.tool[-1], weight(OVER))
    del robot.answers["tare"]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("orientation.topic", "no such name!", "'no such name!': topic name must not contain"),
        (
            "orientation.topic",
            "wrench",
            "'wrench': this node itself has that topic, with WrenchStamped messages and not",
        ),
        ("gravity_source", "tf", "sudo apt install ros-$ROS_DISTRO-tf2-ros-py"),
    ],
)
def test_a_source_that_cannot_be_had(
    robot: Robot, stages: Stages, node: SimulatedNode, monkeypatch: pytest.MonkeyPatch,
    name: str, value: str, words: str,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    before = node.parameters(name)
    done, reason = node.set_parameter(name, value)
    assert not done
    assert words in reason
    assert node.parameters(name) == before
    stages.settle(ZERO6)


def test_nothing_listens_where_no_source_is_chosen(robot: Robot, stages: Stages, node: SimulatedNode) -> None:
    def topics() -> list[str]:
        return [subscription.topic_name for subscription in node.node.subscriptions]

    assert node.name.replace("bridge", "arm/pose") in topics()
    assert node.set_parameter("gravity_source", "imu") == (True, "")
    assert node.name.replace("bridge", "arm/pose") not in topics()
    robot.sending = False
    hold(robot, UP)
    stages.settle(ZERO6)
    status = node.until(compensation=OK)["compensation"]
    assert values(status)["gravity_source"] == "imu"


@pytest.mark.usefixtures("_ros")
def test_tf_that_is_missing_is_told_at_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(StartError, match="parameter gravity_source is 'tf': it needs tf2_ros"):
        SimulatedNode(SimulatedServer(), gravity_source="tf")


# TF.


@pytest.fixture
def ros_node(_ros: None) -> Iterator[Node]:
    made = rclpy.create_node("bridge", namespace="/test_tf")
    yield made
    made.destroy_node()


def test_the_source_tf(ros_node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    tf = FakeTf(monkeypatch)
    check_tf()
    chosen = DEFAULTS.orientation._replace(source="tf", base_frame="world", mounting=ROLLED, stale_after=0.5)
    opened = OrientationListener(ros_node, chosen, "ft", MutuallyExclusiveCallbackGroup())
    with listening(ros_node) as raised:
        source = ListenerSource(DEFAULTS._replace(orientation=chosen), opened)

        def felt(time_s: float) -> Any:
            return source.specific_force(sample(), time_s, time_s)

        wait_until(lambda: tf.asked, "a lookup")
        assert set(tf.asked) == {("world", "ft")}
        assert felt(1000.0) is None
        words = "no orientation from TF from world to ft: TF has no pose of ft in world: frame does not exist"
        wait_until(lambda: source.why_none(sample(), 1000.0) == words, words)
        tf.quaternion, tf.stamp_ns, tf.error = TILTED, lambda: 1000 * 10**9, None
        wait_until(lambda: felt(1000.0) is not None, "a specific force")
        # The frames say all, so `mounting` is not for TF.
        assert felt(1000.0) == pytest.approx((9.80665, 0.0, 0.0))
        assert felt(1000.6) is None
        assert "older than the sample (limit 0.5 s)" in source.why_none(sample(), 1000.6)
        tf.error = "the tree fell apart"
        wait_until(lambda: "the tree fell apart" in source.why_none(sample(), 1000.6), "the reason")
        tf.stamp_ns, tf.error = lambda: 1001 * 10**9, None
        wait_until(lambda: felt(1001.0) is not None, "one again")
        tf.stamp_ns = lambda: 0  # static transforms only: they hold at any time
        wait_until(lambda: felt(time.time()) is not None, "what is always so")
        assert tf.listening == 1
        opened.close()
    assert tf.listening == 0
    assert not raised
    assert not list(ros_node.timers)


def test_a_source_that_fails_ends_the_executor(ros_node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> int:
        raise LookupError("unforeseen")

    tf = FakeTf(monkeypatch)
    tf.error, tf.stamp_ns = None, fail
    opened = OrientationListener(
        ros_node, DEFAULTS.orientation._replace(source="tf"), "ft", MutuallyExclusiveCallbackGroup()
    )
    with listening(ros_node) as raised:
        wait_until(lambda: raised, "the failure")
    assert str(raised[0]) == "unforeseen"
    opened.close()


@pytest.mark.usefixtures("_ros")
def test_topics_are_remapped_as_those_of_the_node_are() -> None:
    remaps = ["--ros-args", "-r", "pose:=/left/pose"]
    node = rclpy.create_node("bridge", namespace="/test_remap", cli_args=remaps)
    group = MutuallyExclusiveCallbackGroup()
    by_topic = OrientationListener(
        node, DEFAULTS.orientation._replace(source="topic_pose", topic="pose"), "ft", group
    )
    assert by_topic.describe == "topic /left/pose"
    by_topic.close()
    node.destroy_node()


def test_without_tf2_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(ParameterError, match=r"sudo apt install ros-.*-tf2-ros-py and source ROS 2, or take"):
        check_tf()


# Time that goes back, and rotations.


def test_a_clock_that_goes_back_does_not_stop_a_source_for_ever() -> None:
    class Listening:
        latest: Oriented | None = Oriented(UPRIGHT, 5_000 * 10**9)
        problem = ""
        describe = "topic /x"

    listening = Listening()
    source = ListenerSource(DEFAULTS, listening)
    assert source.specific_force(sample(), 5000.0, 5000.0) == pytest.approx((0.0, 0.0, 9.80665))
    listening.latest = Oriented(TILTED, 100 * 10**9)
    assert source.specific_force(sample(), 100.0, 100.0) == pytest.approx((9.80665, 0.0, 0.0))


def test_rotations_multiply_in_the_order_that_is_said() -> None:
    both = multiply(TILTED, (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))
    assert length(both[:3]) ** 2 + both[3] ** 2 == pytest.approx(1.0)
    assert multiply(UPRIGHT, TILTED) == multiply(TILTED, UPRIGHT) == pytest.approx(TILTED)
    assert unit_quaternion((0.0, 0.0, 0.0, 0.995)) == UPRIGHT
    assert weight(UP)[2] < 0
