"""How the node starts, waits for its server, finds it again, and ends; in real time what needs executors."""

from __future__ import annotations

import os
import signal
import threading
import time
import uuid

import pytest
from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from bota_ethercat.text.json_text import JsonObject
from bota_ethercat_bridge import rclpy_internals
from bota_ethercat_bridge.node import SERVER_NOT_STOPPED, StartError, run
from bota_ethercat_bridge.rclpy_internals import RIGHT_FOR
from bota_ft_compensation.quantities import Wrench
from tests.bridge.real_node import PATIENCE_S, Listener, Start, StartProcess
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.simulated_node import Node, Server
from tests.server.running import wait_until


def test_every_new_sample_once_and_in_order(server: ScriptedServer, listener: Listener, start: Start) -> None:
    """Through a socket and DDS, in real time."""
    node = start(server.port)
    server.ahead_ns = 60 * 10**9  # the node skips what it comes to read 50 ms after its time
    assert server.subscribed.wait(PATIENCE_S)
    while listener.messages.empty():
        server.send_sample(-1.0)
        time.sleep(0.02)
    server.send_sample(-2.0)
    while listener.next_number() != -2.0:
        pass
    heard = []
    for number in range(100):
        server.send_sample(number)
        time.sleep(0.001)
        if number % 5 == 4:  # a topic keeps ten: a subscriber that is starved of its CPU would miss some
            heard += [listener.next_number() for _ in range(5)]
    assert heard == list(range(100))
    server.send_raw(b"".join(server.frame(number) for number in range(8)))
    assert [listener.next_number() for _ in range(8)] == list(range(8)), "that came together"
    assert "Traceback" not in node.log


@pytest.mark.parametrize(
    ("service", "versions"),
    [*((name, RIGHT_FOR) for name in ("sensor_tare", "tare", "settings.fir")), ("tare", ())],
)
def test_the_supervisor_is_heard_during_each_service(
    server: ScriptedServer, listener: Listener, start: Start, monkeypatch: pytest.MonkeyPatch,
    service: str, versions: tuple[str, ...],
) -> None:  # fmt: skip
    """In real time, with rclpy's own executors: which callback waits for which is what is tested."""
    monkeypatch.setattr(rclpy_internals, "RIGHT_FOR", versions)
    node = start(server.port, **{"rest.duration": 60.0})
    node.says("connected to")
    assert ("this version of rclpy is not known" in node.log) == (not versions)
    server.answers |= {"tare": lambda _: None, "configure": lambda _: None}

    def actions() -> set[str]:
        return {str(request["action"]) for request in server.requests}

    def is_waiting() -> bool:
        return node.node.compensation.output.window is not None or bool({"tare", "configure"} & actions())

    def call() -> None:
        if service == "settings.fir":
            setting = Parameter(service, value=True).to_parameter_msg()
            request = SetParameters.Request(parameters=[setting])
            listener.ask(SetParameters, "set_parameters", request, until=lambda: "shutdown" in actions())
        else:
            listener.ask(Trigger, service, Trigger.Request(), until=lambda: "shutdown" in actions())

    calling = threading.Thread(target=call)
    calling.start()
    wait_until(is_waiting, "the service to wait")
    if service != "settings.fir":  # nor do parameters wait
        assert listener.set_parameter("temperature_variance", 0.5) == (True, "")
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    calling.join()
    assert "shutdown" in actions()
    assert "no reply within" not in node.log
    assert "Traceback" not in node.log


def supervised(server: Server, exit_code: int = 0) -> Node:
    """A node that has been told to stop, and what it has said."""
    with Node(server) as node:
        node.run(0.1)
        (subscription,) = [s for s in node.node.subscriptions if s.topic_name == "/supervisor_status_data"]
        codes = []
        for key, value in (("ft_sensors", "0"), ("camera", "1"), ("ft_sensors", "11"), ("ft_sensors", "1")):
            subscription.callback(KeyValue(key=key, value=value))
            codes.append(node.node.exit_code)
        assert codes == [None, None, None, exit_code]
        node.node.exit_code = 0
    return node


def test_a_supervisor_names_a_sensor_or_a_server() -> None:
    """Two nodes on one computer: of the key's name each takes its own only."""
    servers = {12001: Server(), 12002: Server()}
    servers[12002].description["sensors"][0]["serial"] = 22
    nodes = [Node(each, server_port=port, supervisor_topic="stop") for port, each in servers.items()]
    heard = []
    for node in nodes:
        node.run(0.1)
        (subscription,) = [s for s in node.node.subscriptions if s.msg_type is KeyValue]
        assert subscription.topic_name == node.name.replace("bridge", "stop")
        heard.append(subscription.callback)
    for key, ended in (
        ("ft_sensors/", (None, None)), ("ft_sensors/3", (None, None)), ("ft_sensors/22", (None, 0)),
        ("ft_sensors/localhost:12001", (0, None)), ("ft_sensors", (0, 0)),
    ):  # fmt: skip
        for node, callback in zip(nodes, heard, strict=True):
            node.node.exit_code = None
            callback(KeyValue(key=key, value="1"))
        assert tuple(node.node.exit_code for node in nodes) == ended, key
    for node in nodes:
        node.close()


def test_no_supervisor_is_heard_without_a_topic() -> None:
    with Node(Server(), supervisor_topic="''") as node:
        assert not [s for s in node.node.subscriptions if s.msg_type is KeyValue]


@pytest.mark.parametrize(
    ("reply", "exit_code", "said"),
    [
        (
            {"ok": False, "error": {"code": "denied", "message": "only root"}},
            SERVER_NOT_STOPPED,
            "refused to shut down: only root (denied)",
        ),
        (None, 0, "did not answer the request to shut down"),
    ],
)
def test_a_shutdown_that_is_not_granted(reply: JsonObject | None, exit_code: int, said: str) -> None:
    server = Server()
    server.answers["shutdown"] = lambda _: reply
    assert said in supervised(server, exit_code).log
    assert [request["action"] for request in server.requests].count("shutdown") == 1
    gone = Server()
    gone.listens = False
    assert "could not be told to shut down" in supervised(gone).log


def test_a_managed_node(server: ScriptedServer, listener: Listener, start: Start) -> None:
    """By the services that `ros2 lifecycle` and managers call."""
    node = start(server.port, lifecycle=True)

    def topic_names() -> set[str]:
        return {publisher.topic_name.removeprefix(f"/{listener.tag}/") for publisher in node.node.publishers}

    def change(number: int, *, done: bool = True) -> set[str]:
        """Ask for a transition; the topics that appear or disappear."""
        before, request = topic_names(), ChangeState.Request(transition=Transition(id=number))
        assert listener.ask(ChangeState, "change_state", request).success is done
        return before ^ topic_names()

    change(Transition.TRANSITION_ACTIVATE, done=False)
    assert listener.set_parameter("frame_id", "/ft")[1].endswith("give 'ft'")
    assert listener.set_parameter("frame_id", "ft") == (True, "")
    assert listener.set_parameter("settings.fir", True)[1] == "the node is not active: activate it first"
    assert not change(Transition.TRANSITION_CONFIGURE)
    assert "read-only while" in listener.set_parameter("frame_id", "other")[1]
    assert server.connections == 0
    topics = change(Transition.TRANSITION_ACTIVATE)
    assert {"wrench", "wrench_compensated", "temperature", "diagnostics"} <= topics
    wrenches = listener.subscribe(WrenchStamped, "wrench")
    while wrenches.empty():
        server.subscribed.wait(PATIENCE_S)
        server.send_sample(1.0)
        time.sleep(0.02)
    assert wrenches.get().header.frame_id == "ft"
    node.node.compensation.set_bias(Wrench.of([1.0] * 6), "tare")
    assert change(Transition.TRANSITION_DEACTIVATE) == topics
    assert server.disconnected.wait(PATIENCE_S)
    assert list(listener.parameters("bias")[0]) == [0.0] * 6, "the sensor may be another the next time"
    assert listener.set_parameter("gravity_source", "topic_pose") == (True, "")
    assert listener.set_parameter("orientation.topic", f"/{listener.tag}/array") == (True, "")
    change(Transition.TRANSITION_ACTIVATE, done=False)
    node.says("parameter orientation.topic is")
    assert listener.set_parameter("gravity_source", "imu") == (True, "")
    change(Transition.TRANSITION_CONFIGURE)
    node.node.open = lambda: 1 // 0  # type: ignore[assignment, method-assign]
    change(Transition.TRANSITION_ACTIVATE, done=False)
    node.says("the transition failed: ZeroDivisionError")
    del node.node.open
    change(Transition.TRANSITION_CONFIGURE)
    setting = threading.Thread(target=lambda: node.node.live.put(temperature_variance=0.5))

    def set_meanwhile() -> object:
        if not setting.ident:
            setting.start()
            setting.join(0.2)  # it has to wait
        return type(node.node).get_logger(node.node)

    node.node.get_logger = set_meanwhile  # type: ignore[method-assign]
    change(Transition.TRANSITION_ACTIVATE)
    setting.join()
    assert node.node.compensation.parameters.temperature_variance == 0.5
    assert change(Transition.TRANSITION_ACTIVE_SHUTDOWN) == topics


def test_both_names_of_the_port() -> None:
    with Node(Server(), SERVER_PORT=12345) as node:
        node.run(0.1)
        assert node.parameters("server_port", "SERVER_PORT") == [12345, 12345]
        assert "connected to localhost:12345" in node.log


def test_a_wrong_parameter_is_one_sentence(start_process: StartProcess) -> None:
    """In a process: exit code and output are the user's view of every sentence below."""
    node = start_process(70000)
    assert node.ends() == 2
    (line,) = node.log.splitlines()
    assert line == "bridge-client: parameter server_port is 70000: it must be a whole number from 1 to 65535"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"array_topic": "/NAME"}, "no two topics one name"),
        ({"array_topic": "/NAMEd"}, "no two topics one name"),
        ({"qos_overrides./NAME.publisher.reliability": "foo"}, "check qos_overrides"),
        ({"qos_overrides./NAME.publisher.depth": -1}, "check qos_overrides"),
        (
            {"gravity_source": "topic_pose", "orientation.topic": "imu/data_raw"},
            "parameter orientation.topic is 'imu/data_raw', which this node publishes: name the robot's",
        ),
    ],
)
def test_topics_that_cannot_be_made_are_one_sentence(wrong: dict[str, object], words: str) -> None:
    name = f"n{uuid.uuid4().hex}"  # of its own: DDS has one type for a topic in a process
    given = {key.replace("NAME", name): str(value).replace("NAME", name) for key, value in wrong.items()}
    with pytest.raises(StartError, match=words) as caught:
        Node(Server(), "-r", f"wrench:=/{name}", "-r", f"/diagnostics:=/{name}d", **given)
    assert "\n" not in str(caught.value)


def test_arguments_that_are_not_understood(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["dance"], ["--ros-args", "-p"]):
        assert run(arguments) == 2
        said = capsys.readouterr().err
        assert said.startswith("bridge-client: ")
        assert said.count("\n") == 1


def test_a_signal_at_start_is_no_traceback(server: ScriptedServer, start_process: StartProcess) -> None:
    """In a process: signals are a process's."""
    node = start_process(server.port)

    def signals_blocked() -> bool:
        with open(f"/proc/{node.process.pid}/status") as status:  # noqa: PTH123
            blocked = next(line for line in status if line.startswith("SigBlk:"))
        return bool(int(blocked.split()[1], 16) & 1 << (signal.SIGINT - 1))

    wait_until(signals_blocked, "the first thing it does")
    os.kill(node.process.pid, signal.SIGINT)
    assert node.ends() == 0
    assert "Traceback" not in node.log
