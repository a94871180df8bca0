"""The topics in simulated time: values, units, frames, stamps, QoS; filtered, in other frames, as bytes."""

from __future__ import annotations

import ast
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bota_ethercat.framing import MessageType, encode_data
from bota_ethercat.pdo import encode
from bota_ethercat_bridge import rclpy_internals
from bota_ethercat_bridge.node import StartError
from bota_ethercat_bridge.parameters.table import ParameterError, parse_frames
from bota_ft_compensation.outputs import WrenchFilter
from tests.bridge.fake_tf import FakeTf
from tests.bridge.scripted_server import process_data
from tests.bridge.simulated_node import (
    RATE_HZ,
    STEP_S,
    UP,
    ZERO6,
    Node,
    Server,
    six,
    stamp_ns,
    values,
)
from tests.bridge.test_contact import FACE, PARAMETERS_OF_TOOL
from tests.public_names import listed

PACKAGE = Path(__file__).parents[2] / "ros2_bridge"
QUATERNION = {"orientation.x": 0.5, "orientation.y": -0.5, "orientation.z": 0.5, "orientation.w": 0.5}
NAMES = [f"{name}.{axis}" for name in ("force", "torque", "acceleration", "angular_rate") for axis in "xyz"]
RAW = [2.0 + i / 16 for i in range(12)]
TOPICS = (
    "sensone_sensor_data", "wrench", "imu/data_raw", "imu/data", "temperature", "wrench_compensated/tcp",
    "wrench_filtered",
)  # fmt: skip


class Published:
    def __init__(self, node: Node, server: Server) -> None:
        self.node, self._server = node, server
        self.topics = {name: node.hear(name) for name in TOPICS}
        node.run(0.2)

    def of(self, *samples: dict[str, Any]) -> dict[str, list[Any]]:
        """The messages of these, by topic."""
        for messages in self.topics.values():
            messages.clear()
        for sample in samples:
            self._server.once(**sample)
        self.node.run(len(samples) * STEP_S)
        return self.topics


@pytest.fixture(scope="module", params=["serialized here", "filled in"])
def published(request: pytest.FixtureRequest) -> Iterator[Published]:
    """Also as if rclpy read what is serialized here as something else."""
    server = Server()
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "filled in":
            patch.setattr(rclpy_internals, "deserialize_message", lambda *_: None)
        started = Node(
            server,
            frame_id="left_ft",
            imu_frame_id="left_imu",
            orientation_covariance="[0.1, 0.2, 0.3]",
            linear_acceleration_covariance="[1, 2, 3]",
            temperature_variance=0.25,
            wrench_frames="[tcp 0 0 0.5]",
            **{"filter.cutoff": 10.0},
        )
    with started as node:
        yield Published(node, server)


def vector(message: Any) -> tuple[float, float, float]:
    return message.x, message.y, message.z


def test_every_topic_of_one_sample(published: Published) -> None:
    stamp = 1_234_567_890_123_456_789
    data = encode(61, dict(zip(NAMES, RAW, strict=True)) | {"temperature": 36.5})
    heard = published.of({"process_data": data, "stamp_ns": stamp})
    one = {name: messages[0] for name, messages in heard.items() if messages}
    assert one.keys() == {*TOPICS} - {"imu/data"}, "there is no orientation"
    prefix = published.node.name.removesuffix("bridge")
    assert sorted(one, key=lambda name: published.node.topics[f"{prefix}{name}"].turn) == [
        "wrench", "wrench_compensated/tcp", "wrench_filtered",  # control loops take these
        "sensone_sensor_data", "imu/data_raw", "temperature",
    ]  # fmt: skip
    array, wrench, imu = one["sensone_sensor_data"], one["wrench"], one["imu/data_raw"]
    si = [*RAW[:6], *(v * 9.80665 for v in RAW[6:9]), *(math.radians(v) for v in RAW[9:])]
    assert list(array.data) == pytest.approx(si, rel=1e-12)
    (dimension,) = array.layout.dim
    assert dimension.label == "Fx Fy Fz Mx My Mz Ax Ay Az Rx Ry Rz"
    assert (dimension.size, dimension.stride, array.layout.data_offset) == (12, 12, 0)
    assert [*vector(wrench.wrench.force), *vector(wrench.wrench.torque)] == RAW[:6]
    assert vector(imu.linear_acceleration) == pytest.approx(si[6:9])
    assert vector(imu.angular_velocity) == pytest.approx(si[9:])
    assert (one["temperature"].temperature, one["temperature"].variance) == (36.5, 0.25)
    assert imu.orientation_covariance[0] == -1.0
    assert list(imu.linear_acceleration_covariance) == [1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 3.0]
    assert list(imu.angular_velocity_covariance) == [0.0] * 9
    del one["sensone_sensor_data"]
    assert {stamp_ns(message) for message in one.values()} == {stamp}
    assert {name: message.header.frame_id for name, message in one.items()} == {
        "wrench": "left_ft", "imu/data_raw": "left_imu", "temperature": "left_ft",
        "wrench_compensated/tcp": "tcp", "wrench_filtered": "left_ft",
    }  # fmt: skip


def test_orientation_where_the_sensor_estimates_one(published: Published) -> None:
    heard = published.of(
        {"process_data": encode(77, QUATERNION | {"acceleration.z": 0.5}), "stamp_ns": 7 * 10**9},
        {"process_data": encode(77, {"force.x": 1.0})},  # no estimate
        {"process_data": process_data(1.0, 61)},
        {"process_data": encode(77, QUATERNION), "stamp_ns": 9 * 10**9},
    )
    oriented, raw = heard["imu/data"], heard["imu/data_raw"]
    assert [stamp_ns(message) for message in oriented] == [7 * 10**9, 9 * 10**9]
    for message in oriented:
        q = message.orientation
        assert (q.x, q.y, q.z, q.w) == (0.5, -0.5, 0.5, 0.5)
        assert list(message.orientation_covariance) == [0.1, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.3]
        assert message.header.frame_id == "left_imu"
    assert oriented[0].linear_acceleration.z == pytest.approx(0.5 * 9.80665)
    assert [(m.orientation_covariance[0], m.orientation.w) for m in raw] == [(-1.0, 1.0)] * 4


def test_covariances_are_typical_of_the_filters_in_force_but_for_those_that_are_given() -> None:
    """The noise densities over the bandwidths of the manual's tables."""
    server = Server()
    server.description["sensors"][0]["settings"] |= {"acceleration_filter": 1, "angular_rate_filter": 3}
    server.changes = {"process_data": encode(77, QUATERNION)}
    with Node(server, angular_velocity_covariance="[0.0, 0.5, 0.0]") as node:
        heard = node.hear("imu/data")

        def variances() -> list[list[float]]:
            imu = node.fresh(heard, 0.2)[-1]
            matrices = (
                imu.orientation_covariance,
                imu.angular_velocity_covariance,
                imu.linear_acceleration_covariance,
            )
            assert all(list(each)[1:4] == list(each)[5:8] == [0.0] * 3 for each in matrices)
            return [list(each)[::4] for each in matrices]

        for acceleration_filter, acceleration_hz, rate_filter, rate_hz in ((1, 460, 3, 184), (5, 20, 7, 10)):
            server.reconfigure(acceleration_filter=acceleration_filter, angular_rate_filter=rate_filter)
            orientation, rate, acceleration = variances()
            typical = math.radians(0.01) ** 2 * rate_hz
            assert acceleration == pytest.approx([(250e-6 * 9.80665) ** 2 * acceleration_hz] * 3)
            assert rate == pytest.approx([typical, 0.5, typical])
            assert orientation == pytest.approx([acceleration[0] / 9.80665**2] * 2 + [math.pi**2 / 3])
        node.set("linear_acceleration_covariance", [1.0, 2.0, 3.0])
        assert variances()[1:] == [pytest.approx([typical, 0.5, typical]), [1.0, 2.0, 3.0]]


def test_stamps_of_the_measurement_are_earlier_by_the_delay_of_the_channels_filter() -> None:
    server = Server()
    row = server.description["sensors"][0]
    row["delay_ms"] = {"force_torque": 150.0, "acceleration": 20.0, "angular_rate": 30.0}
    with Node(server, stamp="measurement", **{"filter.cutoff": 10.0}) as node:
        names = "wrench", "wrench_compensated", "compensation/tool", "wrench_filtered", "imu/data_raw"
        topics = [node.hear(name) for name in (*names, "temperature")]
        node.run(0.2)

        def earlier_ms() -> list[float]:
            """Of the next sample, by topic."""
            for messages in topics:
                messages.clear()
            server.once(stamp_ns=10**18)
            node.step()
            return [(10**18 - stamp_ns(message)) / 1e6 for (message,) in topics]

        def clock(expected: str) -> dict[str, str]:
            return values(node.until(clock=expected)["clock"])

        assert earlier_ms() == [150.0] * 4 + [20.0, 0.0]
        told = clock("ok")
        assert (told["stamp"], told["delay_force_torque_ms"]) == ("measurement", "150.0")
        # From the first sample after a change on.
        server.reconfigure(fir=True, delay_ms={"force_torque": 1200.0 / 7, "acceleration": 35.7})
        assert earlier_ms() == [pytest.approx(1200.0 / 7)] * 4 + [35.7, 0.0]
        for _ in range(2):
            server.reconfigure(chop=True, delay_ms={"force_torque": None, "acceleration": "x"})
            assert earlier_ms() == [0.0] * 6
        words = "the delay of the filters is not known, so wrench and imu topics have the time of the sample"
        assert node.log.count(words) == 1
        node.until(words, clock="warn")
        server.reconfigure(delay_ms={"force_torque": 150.0, "acceleration": 20.0})
        assert earlier_ms() == [150.0] * 4 + [20.0, 0.0]
        node.set("stamp", "sample")
        assert earlier_ms() == [0.0] * 6
        assert clock("ok")["delay_acceleration_ms"] == "20.0"


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


# Filtered, and in other frames: configured, subscribed, changed while it runs.


TEN_HZ: dict[str, object] = {"filter.cutoff": 10.0}
HALF = math.sqrt(0.5)


class Sensor(Server):
    """Force along x is a sawtooth of 20 samples while it `shakes`; no tool hangs on it."""

    def __init__(self, *, shakes: bool = True) -> None:
        super().__init__()
        self.shakes = shakes

    def step(self) -> None:
        force = float(self.sent % 20) if self.shakes else 5.0
        self.changes = {"process_data": encode(61, {"force.x": force, "torque.y": 1.0})}
        super().step()


def filtered(messages: list[Any], cutoff_hz: float, rate_hz: float = RATE_HZ) -> dict[int, list[float]]:
    """What the filter makes of these wrenches, none missing, by stamp."""
    made, found = WrenchFilter(), {}
    made.design(cutoff_hz, rate_hz)
    for number, message in enumerate(messages):
        fx, fy, fz, mx, my, mz = six(message)
        time_ns = round(number * STEP_S * 1e9)
        found[stamp_ns(message)] = [*made.step((fx, fy, fz), (mx, my, mz), time_ns).values]
    return found


def check_filtered(got: list[Any], raw: list[Any], fewest: int, cutoff_hz: float) -> None:
    expected = filtered(raw, cutoff_hz)
    assert len(got) >= fewest
    for message in got:
        assert six(message) == pytest.approx(expected[stamp_ns(message)], abs=1e-12)


# wrench_filtered


def test_the_filter_and_its_delay() -> None:
    with Node(Sensor(), bias=[1.0, 0.0, 0.0, 0.0, 0.0, 0.5], **TEN_HZ) as node:
        node.run(0.3)  # nobody listens, but the delay is said
        assert "wrench_filtered is delayed by 21.8 ms: cut-off 10 Hz, sampling rate 100 Hz" in node.log
        raw, got = node.hear("wrench_compensated"), node.hear("wrench_filtered")
        node.run(1.0)
        check_filtered(got, raw, 85, 10.0)
        assert got[0].header.frame_id == "ft_sensor"
        assert six(got[0]) == pytest.approx(six(raw[0])), "no transient"
        assert node.log.count("wrench_filtered") == 1


@pytest.mark.parametrize("set_by_s", [-3600, 3600])
def test_setting_the_wall_clock_does_not_restart_the_filter(set_by_s: int) -> None:
    server = Sensor()
    with Node(server, **TEN_HZ) as node:
        node.run(0.3)
        raw, got = node.hear("wrench_compensated"), node.hear("wrench_filtered")
        node.run(0.55)
        server.clock_step_ns = set_by_s * 10**9
        node.run(0.45)
        check_filtered(got, raw, 95, 10.0)


def test_a_limit_to_the_frequency_comes_after_the_filter() -> None:
    """Otherwise what the limit leaves out would be aliased."""
    with (
        Node(Sensor(), **TEN_HZ) as every,
        Node(Sensor(), publishing_frequency=10.0, **TEN_HZ) as limited,
    ):
        raw, got = every.hear("wrench_compensated"), limited.hear("wrench_filtered")
        every.run(2.0)
        limited.run(2.0)
        assert len(got) < 25
        # Both hear from the same sample on, and the servers' times are the same.
        check_filtered(got, raw, 15, 10.0)


def test_without_a_cut_off_there_is_no_such_topic() -> None:
    with Node(Sensor(), wrench_frames="[]") as node:
        prefix = node.name.removesuffix("bridge")
        assert {name.removeprefix(prefix) for name in node.topics if name.startswith(prefix)} == {
            "sensone_sensor_data", "wrench", "wrench_compensated", "compensation/bias",
            "compensation/tool", "imu/data_raw", "imu/data", "temperature", "bridge/published",
        }  # fmt: skip
        node.run(0.2)
        assert "wrench_filtered" not in node.log
        node.refuse_value("filter.cutoff", 10.0, "wrench_filtered is made at the start, or not at all")
    with Node(Sensor(), **TEN_HZ) as node:
        node.refuse_value("filter.cutoff", 0.0, "wrench_filtered is made at the start, or not at all")


@pytest.mark.parametrize("limit", [50.0, 50.5, 1000.0])
def test_a_frequency_that_the_sampling_rate_does_not_allow_is_refused(limit: float) -> None:
    server = Sensor()
    with Node(server, **TEN_HZ) as node:
        got = node.hear("wrench_filtered")
        node.run(0.3)
        refused = (
            f"filter.cutoff is {limit:g} Hz, but must be below half of the sampling rate, 50 Hz: lower it"
        )
        assert node.set_parameter("filter.cutoff", limit) == (False, refused)
        node.set("filter.cutoff", 49.9)
        assert node.fresh(got, 0.1)
        server.reconfigure(rate_hz=50)
        node.run(0.1)
        node.set("tool_mass", 1.0)  # which changes no frequency
        node.refuse_value("filter.cutoff", 30.0, "must be below half of the sampling rate, 25 Hz")
        server.listens = False
        server.drop()
        node.run(0.1)
        node.set("filter.cutoff", 30.0)  # the next sensor's rate is not known


def test_it_follows_the_sensors_rate() -> None:
    server = Sensor()
    server.description["sensors"][0]["rate_hz"] = 0
    with Node(server, **{"filter.cutoff": 40.0}) as node:
        got = node.hear("wrench_filtered")
        node.until("wrench_filtered has stopped: the server does not report", compensation="error")
        assert not got
        node.unhear("wrench_filtered")
        server.reconfigure(rate_hz=50)
        words = "filter.cutoff is 40 Hz, but must be below half of the sampling rate, 25 Hz"
        node.until(f"wrench_filtered has stopped: {words}", compensation="error")
        node.hear("wrench_filtered")
        assert node.log.count(f"wrench_filtered has stopped: {words}") == 1
        assert not node.fresh(got, 0.2)
        server.reconfigure(rate_hz=200)
        node.until(compensation="ok")
        assert got
        assert "cut-off 40 Hz, sampling rate 200 Hz" in node.log


# wrench_compensated/NAME


def test_a_frame_by_its_pose() -> None:
    """0.2 m before the sensor and turned by 90° about z: what is along x here is along -y there."""
    with Node(
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
    fake.newest_ns, fake.height = server.time_ns, lambda _: -0.2
    return fake


@pytest.fixture
def node(server: Sensor, tf: FakeTf) -> Iterator[Node]:
    with Node(server, wrench_frames="[base, 'tcp 0 0 0.2']") as started:
        yield started


def test_tf_is_not_listened_to_without_a_subscriber(node: Node, tf: FakeTf) -> None:
    node.hear("wrench_compensated/tcp")
    node.run(2.0)
    words = "wrench_compensated/base has stopped: TF has no pose of ft_sensor in base: frame does not exist"
    node.until(words, compensation="error")  # it has never had one, which is said without a subscriber
    tf.error = None
    node.run(0.5)
    assert tf.listening == 0
    tf.asked.clear()
    node.hear("wrench_compensated/base")
    node.run(0.5)
    assert tf.listening == 1
    assert set(tf.asked) == {("base", "ft_sensor")}
    node.unhear("wrench_compensated/base")
    node.run(0.5)
    assert tf.listening == 0
    node.node.compensation.output.frames.close()  # as a managed node that is deactivated
    node.hear("wrench_compensated/base")
    node.run(0.5)
    assert tf.listening == 0


def test_a_frame_that_tf_does_not_know(node: Node, tf: FakeTf) -> None:
    got, others = node.hear("wrench_compensated/base"), node.hear("wrench_compensated")
    node.run(0.5)
    node.until(compensation="ok")  # it may be on its way
    words = "wrench_compensated/base has stopped: TF has no pose of ft_sensor in base: frame does not exist"
    node.until(words, compensation="error")
    assert not got
    assert others
    tf.error, tf.quaternion = None, (0.0, 0.0, 0.0, 0.5)
    node.until("a rotation is a quaternion of length 1", compensation="error")
    tf.quaternion = (0.0, 0.0, 0.0, 1.0)
    node.until(compensation="ok")
    assert got


def test_a_frame_by_tf_and_a_transform_that_is_too_old(node: Node, server: Sensor, tf: FakeTf) -> None:
    tf.error = None
    got = node.hear("wrench_compensated/base")
    node.until(compensation="ok")
    node.run_until(lambda: got, "a wrench")
    assert got[0].header.frame_id == "base"
    assert six(got[0]) == pytest.approx([5.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-9)
    switched_off_ns = server.time_ns()
    tf.newest_ns = lambda: switched_off_ns
    node.run(0.05)
    assert node.fresh(got, 0.04), "within orientation.stale_after"
    node.until(
        "wrench_compensated/base has stopped: TF's latest pose of ft_sensor in base is 0.",
        compensation="error",
    )
    node.until("older than the sample (limit 0.1 s, orientation.stale_after)", compensation="error")
    assert not node.fresh(got, 0.5)
    node.set("orientation.stale_after", 10.0)
    node.until(compensation="ok")
    assert got
    node.set("orientation.stale_after", 0.1)
    node.until(compensation="error")
    tf.newest_ns = lambda: 0  # static transforms only
    node.until(compensation="ok")


def test_a_frame_has_the_latest_pose_and_tells_its_age(server: Sensor, tf: FakeTf) -> None:
    """The robot rises by 1 m/s, and TF is 15 ms behind."""
    tf.error, tf.height = None, lambda at_ns: (at_ns - 10**18) / 1e9
    tf.newest_ns = lambda: server.time_ns() - 15_000_000
    with Node(server, wrench_frames="[base]") as node:
        got = node.hear("wrench_compensated/base")
        node.run(1.0)
        got.clear()
        node.run(1.0)
        stamps = [stamp_ns(message) for message in got]
        assert len(stamps) == 100
        heights = [(message.wrench.torque.y - 1.0) / 5.0 for message in got]
        late_s = [(stamp - 10**18) / 1e9 - z for stamp, z in zip(stamps, heights, strict=True)]
        assert late_s == pytest.approx([late_s[0]] * 100, abs=1e-6)
        assert 0.015 <= late_s[0] + 1e-6 <= 0.015 + STEP_S + 2e-6
        told = values(node.until(compensation="ok")["compensation"])["tf_frame_age_s"]
        assert float(told) == pytest.approx(late_s[0], abs=1e-3)


def test_without_tf2_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(
        StartError, match=r"parameter wrench_frames has 'base' by TF: it needs tf2_ros.*'base x y z'"
    ):
        Node(Sensor(), wrench_frames="[base]")


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (["tool-0"], "'tool-0', which cannot be part of a topic's name"),
        (["/left/tool0"], "has '/left/tool0': frames have no leading slash, give 'left/tool0'"),
        (["0tool 1 2 3"], "'0tool', which cannot be part of a topic's name"),
        (["tcp 1 2"], "it must be NAME, NAME x y z, or NAME x y z qx qy qz qw, in m .2 numbers follow"),
        (["tcp 0 0 x"], "'tcp 0 0 x': it must be NAME.* .could not convert string to float"),
        (["tcp 0 0 150"], "farther than 10 m"),
        (["tcp 0 0 0 0 0 0 0"], "a rotation is a quaternion of length 1, this one's is 0"),
        (["tcp", "tcp 0 0 1"], "names 'tcp' twice"),
    ],
)
def test_what_is_no_frame(texts: list[str], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        parse_frames(texts)


def test_every_topic_is_reliable_unless_its_qos_is_overridden() -> None:
    """A best-effort publisher never reaches a reliable subscriber, which is what most tools are."""
    given = {"filter.cutoff": 10.0, "wrench_frames": "[tcp 0 0 0.5]"}
    best_effort = {"reliability": "best_effort", "depth": 500, "history": "keep_last"}
    best_effort = {f"qos_overrides./mine.publisher.{name}": value for name, value in best_effort.items()}
    with Node(Sensor(), "-r", "wrench:=/mine", **given, **best_effort) as node:
        profiles = {name.rpartition("/")[2]: topic.qos_profile for name, topic in node.topics.items()}
        del profiles["parameter_events"]  # rclpy's
        got = {name: (p.reliability.name, p.durability.name, p.depth) for name, p in profiles.items()}
    assert got.pop("mine") == ("BEST_EFFORT", "VOLATILE", 500)
    assert {"wrench_compensated", "wrench_filtered", "tcp", "data_raw", "diagnostics"} <= got.keys()
    assert got == dict.fromkeys(got, ("RELIABLE", "VOLATILE", 10))


def test_the_profile_of_recording_has_every_topic_of_the_sensor() -> None:
    profiles = yaml.safe_load((PACKAGE / "config" / "record_qos.yaml").read_text())
    names = {line.removeprefix("ROS: topic ") for line in listed(ros=True) if line.startswith("ROS: topic ")}
    assert profiles.keys() == {f"/{name}" for name in names if name[0] not in "/~"}
    for profile in profiles.values():
        policies = {name: value for name, value in profile.items() if name != "depth"}
        assert policies == {"reliability": "reliable", "durability": "volatile", "history": "keep_last"}
        assert profile["depth"] >= 1600, "a second of the fastest sensor"


@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_a_bag_of_every_topic_is_read_by_other_tools(store: Stores, tmp_path: Path) -> None:
    """Written and read by rosbags with the definitions of each distribution: the bytes as they are sent."""
    server = Server()
    with Node(server, **PARAMETERS_OF_TOOL, **{"filter.cutoff": 10.0, "contact.surface": FACE}) as node:
        topics = {name: topic for name, topic in node.topics.items() if not name.endswith("transition_event")}
        for topic in topics.values():
            topic.is_heard = True
        server.hold(UP, size=77, force_z=-200.0, orientation_w=1.0)
        node.run(2.0)
    sent = {name: topic for name, topic in topics.items() if topic.messages}
    assert topics.keys() - sent.keys() == {"/parameter_events"}
    types = get_typestore(store)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, topic in sent.items():
            kind = topic.msg_type.__module__.split(".")[0], "msg", topic.msg_type.__name__
            connection = writer.add_connection(name, "/".join(kind), typestore=types)
            for number, serialized in enumerate(topic.serialized):
                writer.write(connection, number, serialized)
    read: dict[str, list[Any]] = {name: [] for name in sent}
    with AnyReader([tmp_path / "bag"]) as bag:
        for connection, _, serialized in bag.messages():
            read[connection.topic].append(bag.deserialize(serialized, connection.msgtype))
    for name, topic in sent.items():
        assert len(read[name]) == len(topic.messages)
        assert all(map(is_read_as, read[name], topic.messages)), name


def is_read_as(part: Any, message: Any) -> bool:
    """Whether rosbags reads all as rclpy does."""
    if hasattr(message, "get_fields_and_field_types"):
        fields = message.get_fields_and_field_types()
        return all(is_read_as(getattr(part, name), getattr(message, name)) for name in fields)
    if isinstance(message, bytes):  # a level
        return bool(part == message[0])
    if hasattr(message, "__iter__") and not isinstance(message, str):
        return len(part) == len(message) and all(map(is_read_as, part, message))
    return bool(part == message)


def test_topics_and_services_are_those_listed() -> None:
    """In tests/public_names.txt, which docs/stability.md promises to keep."""
    with Node(Sensor(), **{"filter.cutoff": 10.0}) as node:
        namespace = node.name.removesuffix("bridge")
        publishers = node.node.get_publisher_names_and_types_by_node("bridge", namespace[:-1])
        subscribed = [each.topic_name for each in node.node.subscriptions]
        services = [each.srv_name for each in node.node.services]
        made = [each.service_name for each in node.stand_ins]
    topics = {f"ROS: topic {name}" for name in [*(name for name, _ in publishers), *subscribed]}
    names = topics | {f"ROS: service {name}" for name in [*services, *made]}
    ours = {name.replace(namespace + "bridge", "~").replace(namespace, "") for name in names}
    others = re.compile("parameter|rosout|get_type_description|typed/")  # rclpy's; typed only where built
    ours = {name for name in ours if not others.search(name)}
    assert sorted(ours) == listed(ros=True)


def test_with_compat_bota_names_frames_and_tare_are_those_of_botas_driver() -> None:
    text = (PACKAGE / "launch" / "bridge.launch.py").read_text()
    (table,) = re.findall(r"^COMPATIBLE = (.+)$", text, re.MULTILINE)
    name, remappings = ast.literal_eval(table)["bota"]
    told = [word for pair in (("__node", name), *remappings) for word in ("-r", "{}:={}".format(*pair))]
    told += ["--params-file", str(PACKAGE / "config" / "compat_bota.yaml")]
    server = Server()
    with Node(server, *told, **{"rest.duration": 0.3}) as node:
        node.name = node.name.replace("bridge", "bota_ft_sensor")
        wrenches, motions = node.hear(f"{node.name}/wrench"), node.hear(f"{node.name}/imu")
        server.hold(UP)
        node.run(0.2)
        assert six(wrenches[-1])[2] < -5.0, "as measured, with the weight of the tool"
        node.do("tare")
        assert six(node.fresh(wrenches, 0.1)[0]) == pytest.approx(ZERO6, abs=1e-6)
        frames = wrenches[-1].header.frame_id, motions[-1].header.frame_id
        assert frames == ("bota_ft_sensor_wrench", "bota_ft_sensor_imu")


def test_terminals_are_published_as_numbers_and_with_names_and_stamp() -> None:
    """Of a terminal that the server does not read, or whose values are not valid, nothing is."""
    server = Server()
    entries = (("Status", "u8", 0, 8), ("Value", "i16", 8, 16), ("Input", "bool", 24, 1))
    layout = [dict(zip(("name", "type", "bit_offset", "bit_length"), row, strict=True)) for row in entries]
    server.description["terminals"] = [{"terminal": 0, "layout": layout}]
    with Node(server, terminals=2) as node:
        arrays, stamped = node.hear("terminal_0"), node.hear("terminal_0/stamped")
        node.run(0.2)
        assert [each.get("terminals") for each in server.requests if each["action"] == "subscribe"] == [[0]]
        assert "the server reads 1 of 2 terminals" in node.log
        for number, stamp, flags in ((0, 5, 1), (0, 6, 2), (0, 10**10, 0), (7, 8, 0)):
            data = bytes.fromhex("07feff01")
            server.send_raw(encode_data(0, stamp * 10**9, 1, number, flags, 1, data, MessageType.TERMINAL))
        node.run(0.2)
    (array,), (message,) = arrays, stamped
    assert ([*array.data], array.layout.dim[0].label) == ([7.0, -2.0, 1.0], "Status, Value, Input")
    assert ([*message.position], [*message.name]) == ([7.0, -2.0, 1.0], ["Status", "Value", "Input"])
    assert stamp_ns(message) == 5 * 10**9
