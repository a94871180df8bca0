"""wrench_filtered and wrench_compensated/NAME in the node: configured, subscribed, changed while it runs."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor

from bota_ethercat.control import Event, event
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import encode
from bridge.node import StartError
from bridge.parameters.row import ParameterError
from bridge.parameters.table import PARAMETERS, gather_all
from bridge.parameters.wrench_frames import parse
from bridge.publishing.wrench_frames import make_frames
from ft_compensation.outputs.filter import FilterSettings, WrenchFilter
from tests.bridge.compensating import six, stamp_ns
from tests.bridge.conftest import retire
from tests.bridge.fake_tf import FakeTf
from tests.bridge.simulated_node import STEP_S, SimulatedNode, SimulatedServer
from tests.bridge.streaming import RATE_HZ, SETTINGS
from tests.server.running import wait_until

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("_ros")]
OK, WARN, ERROR, STALE = range(4)
TEN_HZ: dict[str, object] = {"filter.cutoff": 10.0}
HALF = math.sqrt(0.5)


class Sensor(SimulatedServer):
    """Force along x is a sawtooth of 20 samples while it `shakes`; no tool hangs on it."""

    def __init__(self, *, shakes: bool = True) -> None:
        super().__init__()
        self.shakes = shakes
        self.on_step: Callable[[], None] = lambda: None
        self.clock_step_ns = 0
        """By how much the wall clock has been set."""

    def time_ns(self) -> int:
        return super().time_ns() + self.clock_step_ns

    def step(self) -> None:
        force = float(self.sent % 20) if self.shakes else 5.0
        self.changes = {"process_data": encode(61, {"force.x": force, "torque.y": 1.0})}
        super().step()
        self.on_step()


def filtered(messages: list[Any], rate_hz: float = RATE_HZ, **settings: float) -> dict[int, list[float]]:
    """What the filter makes of these wrenches, none missing, by stamp."""
    made, found = WrenchFilter(), {}
    made.design(FilterSettings(**settings), rate_hz)
    for number, message in enumerate(messages):
        fx, fy, fz, mx, my, mz = six(message)
        time_ns = round(number * STEP_S * 1e9)
        found[stamp_ns(message)] = [*made.step((fx, fy, fz), (mx, my, mz), time_ns).values]
    return found


def check_filtered(got: list[Any], raw: list[Any], fewest: int, **settings: float) -> None:
    expected = filtered(raw, **settings)
    assert len(got) >= fewest
    for message in got:
        assert six(message) == pytest.approx(expected[stamp_ns(message)], abs=1e-12)


def test_nothing_more_unless_it_is_configured() -> None:
    with SimulatedNode(Sensor()) as node:
        prefix = node.name.removesuffix("bridge")
        assert {name.removeprefix(prefix) for name in node.topics if name.startswith(prefix)} == {
            "sensone_sensor_data", "wrench", "wrench_compensated", "compensation/bias",
            "compensation/tool", "imu/data_raw", "imu/data", "temperature",
        }  # fmt: skip
        node.run(0.2)
        assert "wrench_filtered" not in node.log


# wrench_filtered


def test_the_filter_and_its_delay() -> None:
    with SimulatedNode(Sensor(), bias=[1.0, 0.0, 0.0, 0.0, 0.0, 0.5], **TEN_HZ) as node:
        node.run(0.3)  # nobody listens, but the delay is said
        assert "wrench_filtered is delayed by 21.8 ms: cut-off 10 Hz, sampling rate 100 Hz" in node.log
        raw, got = node.hear("wrench_compensated"), node.hear("wrench_filtered")
        node.run(1.0)
        check_filtered(got, raw, 85, cutoff=10.0)
        assert got[0].header.frame_id == "ft_sensor"
        assert six(got[0]) == pytest.approx(six(raw[0])), "no transient"
        assert node.log.count("wrench_filtered") == 1


@pytest.mark.parametrize("set_by_s", [-3600, 3600])
def test_setting_the_wall_clock_does_not_restart_the_filter(set_by_s: int) -> None:
    server = Sensor()
    with SimulatedNode(server, **TEN_HZ) as node:
        node.run(0.3)
        raw, got = node.hear("wrench_compensated"), node.hear("wrench_filtered")
        node.run(0.55)
        server.clock_step_ns = set_by_s * 10**9
        node.run(0.45)
        check_filtered(got, raw, 95, cutoff=10.0)


def test_a_limit_to_the_frequency_comes_after_the_filter() -> None:
    """Otherwise what the limit leaves out would be aliased."""
    with (
        SimulatedNode(Sensor(), **TEN_HZ) as every,
        SimulatedNode(Sensor(), publishing_frequency=10.0, **TEN_HZ) as limited,
    ):
        raw, got = every.hear("wrench_compensated"), limited.hear("wrench_filtered")
        every.run(2.0)
        limited.run(2.0)
        assert len(got) < 25
        # Both hear from the same sample on, and the servers' times are the same.
        check_filtered(got, raw, 15, cutoff=10.0)


def test_it_can_be_configured_while_the_node_runs() -> None:
    with SimulatedNode(Sensor()) as node:
        node.run(0.2)
        assert node.set_parameter("filter.cutoff", 10) == (True, "")
        got = node.hear("wrench_filtered")
        node.run(0.5)
        assert got
        assert node.set_parameter("filter.notch", 20.0) == (True, "")
        assert node.set_parameter("filter.dead_band_force", 100.0) == (True, "")
        node.run(0.5)
        assert "wrench_filtered is delayed by 24.1 ms: cut-off 10 Hz, notch 20 Hz" in node.log
        assert got[-1].wrench.force.x == 0.0
        assert node.set_parameter("filter.cutoff", 0.0) == (True, "")
        node.run(0.05)
        got.clear()
        node.run(0.2)
        assert not got
        node.until(compensation=OK)
        done, reason = node.set_parameter("filter.cutoff", 0.01)
        assert not done
        assert "it must be 0, for none, or at least 0.05 Hz" in reason


@pytest.mark.parametrize("limit", [50.0, 50.5, 1000.0])
def test_a_frequency_that_the_sampling_rate_does_not_allow_is_refused(limit: float) -> None:
    server = Sensor()
    with SimulatedNode(server, **TEN_HZ) as node:
        got = node.hear("wrench_filtered")
        node.run(0.3)
        for name in ("cutoff", "notch"):
            refused = (
                f"filter.{name} is {limit:g} Hz, but must be below half of the sampling rate, 50 Hz: lower it"
            )
            assert node.set_parameter(f"filter.{name}", limit) == (False, refused)
        assert node.set_parameter("filter.notch_width", limit) == (True, ""), "there is no notch"
        assert not node.set_parameter("filter.notch", 20.0)[0]
        assert node.set_parameter("filter.cutoff", 49.9) == (True, "")
        got.clear()
        node.run(0.1)
        assert got
        server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS, rate_hz=50))
        node.run(0.1)
        assert node.set_parameter("filter.dead_band_force", 1.0) == (True, ""), "which changes no frequency"
        assert (
            "must be below half of the sampling rate, 25 Hz" in node.set_parameter("filter.cutoff", 30.0)[1]
        )
        server.listens = False
        server.drop()
        node.run(0.1)
        assert node.set_parameter("filter.cutoff", 30.0) == (True, ""), "the next sensor's rate is not known"


def test_it_follows_the_sensors_rate() -> None:
    server = Sensor()
    with SimulatedNode(server, **{"filter.cutoff": 40.0}) as node:
        got = node.hear("wrench_filtered")
        node.run(0.3)
        server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS, rate_hz=50))
        words = "filter.cutoff is 40 Hz, but must be below half of the sampling rate, 25 Hz"
        node.until(f"wrench_filtered has stopped: {words}", compensation=ERROR)
        assert node.log.count(f"wrench_filtered has stopped: {words}") == 1
        got.clear()
        node.run(0.2)
        assert not got
        server.send_json(event(Event.RECONFIGURED, sensor=0, settings=SETTINGS, rate_hz=200))
        node.until(compensation=OK)
        assert got
        assert "cut-off 40 Hz, sampling rate 200 Hz" in node.log


def test_a_server_that_does_not_tell_the_rate() -> None:
    server = Sensor()
    server.description["sensors"][0]["rate_hz"] = 0
    with SimulatedNode(server, **TEN_HZ) as node:
        got = node.hear("wrench_filtered")
        node.until("wrench_filtered has stopped: the server does not report", compensation=ERROR)
        assert not got


# wrench_compensated/NAME


def test_a_frame_by_its_pose() -> None:
    """0.2 m before the sensor and turned by 90° about z: what is along x here is along -y there."""
    with SimulatedNode(
        Sensor(shakes=False), wrench_frames=f"['tcp 0 0 0.2 0 0 {HALF} {HALF}', 'tool/tip 0 0 0.1']"
    ) as node:
        tcp, tip = node.hear("wrench_compensated/tcp"), node.hear("wrench_compensated/tool/tip")
        node.run(0.3)
        assert tcp[-1].header.frame_id == "tcp"
        assert tip[-1].header.frame_id == "tool/tip"
        # 5 N x 0.2 m = the 1 Nm that the sensor measures: the force acts at the TCP.
        assert six(tcp[-1]) == pytest.approx([0.0, -5.0, 0.0, 0.0, 0.0, 0.0], abs=1e-9)
        assert six(tip[-1]) == pytest.approx([5.0, 0.0, 0.0, 0.0, 0.5, 0.0], abs=1e-9)


@pytest.fixture
def server() -> Sensor:
    return Sensor(shakes=False)


@pytest.fixture
def tf(server: Sensor, monkeypatch: pytest.MonkeyPatch) -> FakeTf:
    fake = FakeTf(monkeypatch)
    fake.stamp_ns, fake.height = server.time_ns, -0.2
    return fake


@pytest.fixture
def node(server: Sensor, tf: FakeTf) -> Iterator[SimulatedNode]:
    with SimulatedNode(server, wrench_frames="[base, 'tcp 0 0 0.2']") as started:

        def look() -> None:
            for timer in list(started.node.timers):
                timer.callback()  # as the executor would call it

        server.on_step = look
        yield started


def test_tf_is_not_listened_to_without_a_subscriber(node: SimulatedNode, tf: FakeTf) -> None:
    node.hear("wrench_compensated/tcp")
    node.run(0.5)
    assert tf.listening == 0
    assert not tf.asked
    node.hear("wrench_compensated/base")
    node.run(0.5)
    assert tf.listening == 1
    assert set(tf.asked) == {("base", "ft_sensor")}
    node.topics[node.name.replace("bridge", "wrench_compensated/base")].is_heard = False
    node.run(0.5)
    assert tf.listening == 0
    assert not list(node.node.timers)


def test_a_frame_by_tf(node: SimulatedNode, tf: FakeTf) -> None:
    tf.error = None
    got = node.hear("wrench_compensated/base")
    node.until(compensation=OK)
    node.run_until(lambda: got, "a wrench")
    assert got[0].header.frame_id == "base"
    assert six(got[0]) == pytest.approx([5.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-9)


def test_a_frame_that_tf_does_not_know(node: SimulatedNode, tf: FakeTf) -> None:
    got, others = node.hear("wrench_compensated/base"), node.hear("wrench_compensated")
    node.run(0.5)
    node.until(compensation=OK)  # it may be on its way
    words = "wrench_compensated/base has stopped: TF has no pose of ft_sensor in base: frame does not exist"
    node.until(words, compensation=ERROR)
    assert not got
    assert others
    tf.error, tf.quaternion = None, (0.0, 0.0, 0.0, 0.5)
    node.until("a rotation is a quaternion of length 1", compensation=ERROR)
    tf.quaternion = (0.0, 0.0, 0.0, 1.0)
    node.until(compensation=OK)
    assert got


def test_a_transform_that_is_too_old(node: SimulatedNode, server: Sensor, tf: FakeTf) -> None:
    tf.error = None
    got = node.hear("wrench_compensated/base")
    node.run_until(lambda: got, "a wrench")
    tf.error = "the robot was switched off"
    node.run(0.05)
    got.clear()
    node.run(0.04)
    assert got, "within orientation.stale_after"
    node.until(
        "wrench_compensated/base has stopped: TF's latest pose of ft_sensor in base is 0.", compensation=ERROR
    )
    node.until("older than the sample (limit 0.1 s, orientation.stale_after)", compensation=ERROR)
    got.clear()
    node.run(0.5)
    assert not got
    assert node.set_parameter("orientation.stale_after", 10.0) == (True, "")
    node.until(compensation=OK)
    assert got
    assert node.set_parameter("orientation.stale_after", 0.1) == (True, "")
    tf.error, tf.stamp_ns = None, lambda: server.time_ns() + 10**9
    node.until("is 1 s newer than the sample", compensation=ERROR)
    tf.stamp_ns = lambda: 0  # static transforms only
    node.until(compensation=OK)


def test_tf_in_a_real_executor(server: Sensor, tf: FakeTf) -> None:
    """The guard condition and the timer, which nothing calls in simulated time."""
    node = rclpy.create_node("bridge", namespace="/test_frames")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    tf.error = None
    defaults = {row.name: row.default for row in PARAMETERS}
    (topic,) = make_frames(node, gather_all(defaults | {"wrench_frames": ("base",)}))
    heard: list[Any] = []

    def publishes() -> bool:
        assert topic.is_wanted()
        topic.send((1.0, 2.0, 3.0), (0.0, 0.0, 0.0), DataMessage(1, server.time_ns(), 0, 0, 0, 3, b""))
        executor.spin_once(0.01)
        return bool(heard)

    def is_closed() -> bool:
        executor.spin_once(0.01)
        return not topic.is_wanted() and not tf.listening

    try:
        name = "/test_frames/wrench_compensated/base"
        subscription = node.create_subscription(WrenchStamped, name, heard.append, 10)
        wait_until(topic.is_wanted, "the subscription")
        wait_until(publishes, "a wrench")
        assert tf.listening == 1
        node.destroy_subscription(subscription)
        wait_until(is_closed, "the end")
    finally:
        executor.shutdown()
        retire(node)


def test_without_tf2_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(
        StartError, match=r"parameter wrench_frames has 'base' by TF: it needs tf2_ros.*'base x y z'"
    ):
        SimulatedNode(Sensor(), wrench_frames="[base]")


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["tool-0"], "'tool-0', which cannot be part of a topic's name"),
        (["0tool 1 2 3"], "'0tool', which cannot be part of a topic's name"),
        (["/base"], "cannot be part of a topic's name"),
        (["tcp 1 2"], "it must be NAME, NAME x y z, or NAME x y z qx qy qz qw, in m .2 numbers follow"),
        (["tcp 0 0 x"], "'tcp 0 0 x': it must be NAME.* .could not convert string to float"),
        (["tcp 0 0 nan"], "it must be NAME"),
        (["tcp 0 0 150"], "farther than 10 m"),
        (["tcp 0 0 0 0 0 0 0"], "a rotation is a quaternion of length 1, this one's is 0"),
        (["tcp", "tcp 0 0 1"], "names 'tcp' twice"),
    ],
)
def test_what_is_no_frame(texts: list[str], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        parse(texts)


@pytest.mark.parametrize("value", ["['']", "[]"])
def test_no_frames(value: str) -> None:
    with SimulatedNode(Sensor(), wrench_frames=value) as node:
        assert node.parameters("wrench_frames") == [[""]]


def qos(node: SimulatedNode) -> dict[str, tuple[str, str, int]]:
    """Reliability, durability and depth of the node's own topics."""
    profiles = {name.rpartition("/")[2]: topic.qos_profile for name, topic in node.topics.items()}
    del profiles["parameter_events"]  # rclpy's
    return {name: (p.reliability.name, p.durability.name, p.depth) for name, p in profiles.items()}


def test_every_topic_is_reliable_unless_its_qos_is_overridden() -> None:
    """A best-effort publisher never reaches a reliable subscriber, which is what most tools are."""
    with SimulatedNode(Sensor(), **{"filter.cutoff": 10.0, "wrench_frames": "[tcp 0 0 0.5]"}) as node:
        expected = dict.fromkeys(qos(node), ("RELIABLE", "VOLATILE", 10))
        assert {"wrench", "wrench_filtered", "tcp", "data_raw", "diagnostics"} <= expected.keys()
        assert qos(node) == expected
    best_effort = {"qos_overrides./mine.publisher.reliability": "best_effort"}
    with SimulatedNode(Sensor(), "-r", "wrench:=/mine", **best_effort) as node:
        assert {name for name, (reliability, *_) in qos(node).items() if reliability != "RELIABLE"} == {
            "mine"
        }
