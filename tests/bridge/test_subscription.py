"""What a subscriber has lost is counted to the sample: by the node's counts, in Python and in C++."""

from __future__ import annotations

import math
import random
import subprocess
import threading
import time
from array import array
from bisect import bisect_right
from collections import deque
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Temperature

from bota_ethercat.pdo import encode
from bota_ethercat_bridge import check_subscription, rclpy_internals
from bota_ethercat_bridge.subscription import Counted, Subscription, report
from tests.bridge.real_node import retire
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.simulated_node import STEP_S, Node, Server, stamp_ns, values
from tests.clients.cpp_programs import SANITIZED, SOURCES, build, needs_gxx, patient
from tests.server.running import PATIENCE_S
from tests.simulation import more_if_long

QUATERNION = {"orientation.w": 1.0}
Event = tuple[str, Any]


class Subscriber:
    """Gets the messages of a topic in time or late, and not those that it drops; so the reports."""

    def __init__(self, node: Node, topic: str, seed: int) -> None:
        self._node, self._random = node, random.Random(seed)
        self._sources = {"receive": node.hear(topic), "published": node.hear("bridge/published")}
        self._queues: dict[str, deque[Any]] = {name: deque() for name in self._sources}
        self.counted = Subscription(node.name.removesuffix("bridge") + topic)
        self.dropped, self.dropping, self.is_matched = 0, 0.0, True
        self.events: list[Event] = []

    def step(self) -> None:
        for name, source in self._sources.items():
            for message in source:
                if name == "receive" and (not self.is_matched or self._random.random() < self.dropping):
                    self.dropped += self.is_matched
                elif name == "receive" or self._random.random() < 0.7:
                    self._queues[name].append(message)
            source.clear()
            if self._random.random() < 0.2:  # late by many samples
                while self._queues[name]:
                    self.deliver(name, self._queues[name].popleft())

    def deliver(self, name: str, message: Any) -> None:
        argument = message.header.stamp if name == "receive" else message
        self.events.append((name, argument))
        more = (self._node.server.time_ns(),) if name == "receive" else ()
        before = self.counted.lost
        getattr(self.counted, name)(argument, *more)
        assert self.counted.lost >= before, "each report is right by itself"

    def run(self, seconds: float, dropping: float = 0.0) -> None:
        self.dropping = dropping
        for _ in range(round(seconds / STEP_S)):
            self._node.step()
            self.step()

    def finish(self) -> int:
        """What was lost, once nothing is under way."""
        self.run(1.0)
        for name in ("published", "receive"):
            while self._queues[name]:
                self.deliver(name, self._queues[name].popleft())
        return self.counted.lost


@pytest.fixture(params=["wrench", "wrench_compensated", "imu/data", "temperature"])
def topic(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("seed", more_if_long([1], range(1, 12)))
def test_lost_messages_are_counted_to_the_sample(topic: str, seed: int) -> None:
    """Also while the node leaves out samples of the topic: not finite, without orientation, limited."""
    server, rng = Server(), random.Random(-seed)
    bad = [{"temperature": float("nan")}, {"force.x": float("inf")}, {"orientation.x": float("nan")}, {}]

    def step() -> None:
        server.changes = {"process_data": encode(77, QUATERNION)}
        if rng.random() < 0.2:
            server.changes = {"process_data": encode(77, rng.choice(bad))}
        Server.step(server)

    server.step = step  # type: ignore[method-assign]
    with Node(server) as node:
        subscriber = Subscriber(node, topic, seed)
        subscriber.is_matched = False
        subscriber.run(1.0)  # published for others, before this one is matched
        subscriber.is_matched = True
        subscriber.run(1.0)
        subscriber.run(3.0, dropping=0.3)
        node.set("publishing_frequency", 30.0)
        subscriber.run(2.0, dropping=0.3)
        node.set("publishing_frequency", 0.0)
        subscriber.run(1.0, dropping=0.3)
        lost = subscriber.finish()
    assert lost == subscriber.dropped > 50
    assert subscriber.counted.received > 100


def test_every_report_is_exact(topic: str) -> None:
    server, heard = Server(), list[int]()
    with Node(server) as node:
        messages, reports = node.hear(topic), node.hear("bridge/published")
        for number in range(300):
            names = ("orientation.w", "temperature", "orientation.x", "force.x")
            numbers = [1.0, *(math.nan if number % n == 0 else 0.0 for n in (2, 3, 7))]
            server.changes = {"process_data": encode(77, dict(zip(names, numbers, strict=True)))}
            node.step()
            heard += [stamp_ns(message) for message in messages]
            messages.clear()
            for values_of in (each for report in reports for each in by_topic(node, report, topic)):
                assert int(values_of["count"]) == bisect_right(heard, int(values_of["stamp_ns"]))
            reports.clear()
    assert len(heard) > 50


def by_topic(node: Node, report: Any, topic: str) -> list[dict[str, str]]:
    name = node.name.removesuffix("bridge") + topic
    return [values(status) for status in report.status if status.name == name]


def test_what_was_lost_on_the_bus_is_missing_but_not_lost() -> None:
    server = Server()
    with Node(server) as node:
        subscriber = Subscriber(node, "wrench", 3)
        subscriber.run(1.5)
        for _ in range(7):
            server.now_ns += round(STEP_S * 1e9)
        subscriber.run(1.0)
        subscriber.run(0.05, dropping=1.0)
        subscriber.run(0.5)
        assert (subscriber.finish(), subscriber.counted.missing) == (5, 12)


def test_it_begins_anew_with_a_clock_that_is_set_back_and_a_node_that_starts_anew() -> None:
    server = Server()
    with Node(server) as node:
        subscriber = Subscriber(node, "wrench", 5)
        subscriber.run(1.0)
        server.clock_step_ns = -3 * 10**9
        subscriber.run(1.0)
        subscriber.run(1.0, dropping=0.5)
        before = subscriber.finish()
        assert before == subscriber.dropped > 30
        received = subscriber.counted.received
    counted, server = subscriber.counted, Server()
    server.now_ns += 10 * 10**9
    with Node(server) as node:
        other = Subscriber(node, "wrench", 6)
        counted._topic, other.counted = other.counted._topic, counted
        other.run(1.0)
        other.run(1.0, dropping=0.5)
        assert other.finish() - before == other.dropped > 30
        assert counted.received > received + 100


def test_nobody_asks_for_the_counts_unless_somebody_listens() -> None:
    with Node(Server()) as node:
        node.hear("wrench")
        node.run(0.5)
        assert node.node.reader.between_samples is None


@needs_gxx
@patient
def test_cpp_counts_the_same(tmp_path: Path) -> None:
    server = Server()
    with Node(server) as node:
        subscriber = Subscriber(node, "wrench", 7)
        subscriber.run(1.0)
        subscriber.run(2.0, dropping=0.3)
        server.clock_step_ns = -(10**9)
        subscriber.run(2.0, dropping=0.3)
        subscriber.finish()
        name = f"{node.name.removesuffix('bridge')}wrench"
    lines = [name]
    for kind, argument in subscriber.events:
        if kind == "receive":
            lines.append(f"r {argument.sec} {argument.nanosec}")
        for status in argument.status if kind == "published" else ():
            lines.append(" ".join(["p", status.name, *(value.value for value in status.values)]))
    program = build(SOURCES / "subscription.cpp", SANITIZED)
    said = subprocess.run(
        [program], input="\n".join(lines), capture_output=True, text=True, check=True
    ).stdout
    counted = subscriber.counted
    assert [int(word) for word in said.split()] == [counted.received, counted.lost, counted.missing]
    assert counted.lost > 50


@pytest.mark.parametrize(
    ("lost", "depth", "age_ms", "best_effort", "words"),
    [
        (0, 10, 1.0, False, ""),
        (5, 10, 1.0, False, "raise the depth to 100"),
        (5, 10, 1.0, True, "lost by best effort"),
        (5, 100, 120.0, False, "the queue is always full"),
        (5, 1000, 3.0, False, "long pauses"),
        (0, 1000, 8.0, False, "too old for a control loop"),
    ],
)
def test_what_to_change(lost: int, depth: int, age_ms: float, best_effort: bool, words: str) -> None:
    counted = Counted("/wrench")
    counted.received, counted.lost, counted.missing, counted.rate_hz = 800, lost, lost, 800.0
    counted.ages.count(array("f", [age_ms * 1e6] * 800))
    said = [*report(counted, depth, best_effort=best_effort)]
    assert f"received 800, lost {lost}, missing {lost}" == said[0]
    assert words in " ".join(said[2:])
    assert bool(said[2:]) == bool(words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["wrench", "--depth", "0"], "--depth: '0': it must be a whole number from 1"),
        (["wrench", "--for", "-1"], "--for: '-1': it must be a number of seconds"),
        (["a b"], "'a b' is no topic: failed to resolve name: topic name must not contain"),
    ],
)
def test_wrong_arguments_are_one_sentence(
    arguments: list[str], words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rclpy, "init", lambda **_: None)  # it is up
    with pytest.raises(SystemExit) as ended:
        check_subscription.main(arguments)
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


def test_ctrl_c_before_the_first_message_blames_nobody(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(rclpy, "init", lambda **_: None)  # it is up, and stays so
    monkeypatch.setattr(rclpy, "try_shutdown", lambda: None)
    monkeypatch.setattr(check_subscription, "_find", interrupt)
    assert check_subscription.main(["wrench"]) == 1
    assert capsys.readouterr() == ("", "bridge-check-subscription: stopped\n")


def test_without_ros_it_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def init(**_: object) -> None:
        raise RuntimeError("failed to initialize rcl: ROS_DOMAIN_ID is not an integral number, at /a/b.c:49")

    monkeypatch.setattr(rclpy, "init", init)
    with pytest.raises(SystemExit) as ended:
        check_subscription.main(["wrench"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith("rcl: ROS_DOMAIN_ID is not an integral number\n")


@pytest.mark.parametrize("known", [True, False])
def test_what_waits_takes_every_message_once_in_order(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of real DDS, with what is right for this version of rclpy and for any."""
    monkeypatch.setattr(rclpy_internals, "is_known", lambda: known)
    sending, own = (rclpy.create_node(f"taking_{name}_{known}") for name in "ab")
    publisher = sending.create_publisher(Temperature, f"taking_{known}", 1000)
    heard, sent = list[float](), [float(number) for number in range(250)]

    def hear(message: Any) -> None:
        heard.append(message.temperature)

    take = rclpy_internals.taking(own, own.create_subscription(Temperature, f"taking_{known}", hear, 1000))
    deadline = time.monotonic() + PATIENCE_S
    while not publisher.get_subscription_count() and time.monotonic() < deadline:
        take(0.01)
    for number in sent:
        publisher.publish(Temperature(temperature=number))
    while len(heard) < len(sent) and time.monotonic() < deadline:
        take(0.1)
    retire(sending)
    retire(own)
    assert heard == sent


@pytest.mark.long
def test_over_dds_what_a_slow_subscriber_loses_is_counted(start: Any, listener: Any) -> None:
    with ScriptedServer() as server:
        node = start(server.port).node
        counted, pause = Subscription(f"/{listener.tag}/wrench"), 0.0
        own = rclpy.create_node(f"{listener.tag}_slow", start_parameter_services=False)

        def receive(message: Any) -> None:
            counted.receive(message.header.stamp, time.time_ns())
            time.sleep(pause)

        own.create_subscription(DiagnosticArray, f"/{listener.tag}/bridge/published", counted.published, 10)
        own.create_subscription(WrenchStamped, f"/{listener.tag}/wrench", receive, 50)
        executor = SingleThreadedExecutor()
        executor.add_node(own)

        def pass_time(seconds: float) -> None:
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                executor.spin_once(0.01)

        def send(numbers: range) -> None:
            for number in numbers:
                server.send_sample(float(number))
                time.sleep(0.002)

        def send_all(numbers: range) -> None:
            sender = threading.Thread(target=send, args=[numbers])
            sender.start()
            while sender.is_alive():
                executor.spin_once(0.01)

        server.subscribed.wait(PATIENCE_S)
        sent = 0
        while not counted.rate_hz:
            send_all(range(sent, sent + 100))
            sent += 100
        pass_time(0.5)  # for the reports
        begun = published(node) - counted.received  # before the two had found each other
        assert counted.lost == 0
        pause = 0.02
        send_all(range(sent, sent + 1000))
        pause = 0.0
        send_all(range(sent + 1000, sent + 1200))
        pass_time(0.5)
        executor.shutdown()
        retire(own)
        assert counted.lost > 200
        assert counted.received + counted.lost + begun == published(node)


def published(node: Any) -> int:
    counts = node.reader.counts
    return int(counts.new - counts.stale)
