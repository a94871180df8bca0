"""How the node starts, waits for its server, finds it again, and ends."""

from __future__ import annotations

import os
import signal
import threading

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

from diagnostic_msgs.msg import KeyValue
from std_srvs.srv import Trigger

from bridge.node import SERVER_GOES_ON, SUPERVISOR_TOPIC, run
from tests.bridge.conftest import Listener, Start, StartProcess, establish, wait_until
from tests.bridge.scripted_server import ScriptedServer
from tests.bridge.simulated_node import SimulatedNode, SimulatedServer

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("_ros")]


def free_port() -> int:
    """A port that nobody listens on."""
    with ScriptedServer() as gone:
        return gone.port


def test_waits_for_the_server_and_finds_it_again(listener: Listener, start: Start) -> None:
    port = free_port()
    node = start(port)
    node.says("no server at localhost")
    with ScriptedServer(port) as server:
        establish(server, listener)
    with ScriptedServer(port) as server:
        establish(server, listener)
        server.send_sample(5.0)
        assert listener.next_number() == 5.0
    node.says("connection to localhost", 2)
    assert node.log.count("no server at") == 1, "said once, not at every attempt"
    assert node.log.count("connected again") == 1
    node.finish()
    assert node.ends() == 0


@pytest.mark.parametrize(
    ("service", "action", "words"),
    [
        ("sensor_tare", "tare", "did not answer tare: the node ends"),
        ("tare", "describe", "tare failed: the node ends"),
        ("identify/add_pose", "describe", "add_pose failed: the node ends"),
        ("get_settings", "describe", "did not answer describe: the node ends"),
        ("a parameter", "configure", "is shutting down"),
    ],
)
def test_the_supervisor_is_heard_during_each_service(
    server: ScriptedServer, listener: Listener, start: Start, service: str, action: str, words: str
) -> None:
    """In real time, with rclpy's own executors: which callback waits for which is what is tested."""
    node = start(server.port, **{"rest.duration": 60.0})
    node.says("connected to")
    if service == "identify/add_pose":
        assert listener.trigger("identify/start")[0]
    if action != "describe" or service == "get_settings":
        server.answers[action] = lambda _: None

    def is_asked() -> bool:
        if service in {"tare", "identify/add_pose"}:
            return node.node.compensation.output.window is not None
        # The diagnostics ask too, but no second time before they are answered.
        asked = [request["action"] for request in server.requests]
        return asked.count(action) == (2 if action == "describe" else 1)

    def has_stopped() -> bool:
        return "shutdown" in [request["action"] for request in server.requests]

    def call() -> None:
        if service == "a parameter":
            listener.set_parameter("settings.fir", True, until=has_stopped)
        else:
            listener.call(Trigger, service, until=has_stopped)

    del server.requests[2:]
    calling = threading.Thread(target=call)
    calling.start()
    wait_until(is_asked, "the service to wait")
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    calling.join()
    assert has_stopped()
    node.says(words)
    assert "no reply within" not in node.log
    assert "Traceback" not in node.log


def supervised(server: SimulatedServer, exit_code: int = 0) -> SimulatedNode:
    """A node that has been told to stop, and what it has said."""
    with SimulatedNode(server) as node:
        node.run(0.1)
        (subscription,) = [s for s in node.node.subscriptions if s.topic_name == SUPERVISOR_TOPIC]
        codes = []
        for key, value in (("ft_sensors", "0"), ("camera", "1"), ("ft_sensors", "11"), ("ft_sensors", "1")):
            subscription.callback(KeyValue(key=key, value=value))
            codes.append(node.node.exit_code)
        assert codes == [None, None, None, exit_code]
        node.node.exit_code = 0
    return node


def test_a_refused_shutdown_is_an_error() -> None:
    server = SimulatedServer()
    error = {"code": "denied", "message": "only root"}
    server.answers["shutdown"] = lambda _: {"ok": False, "error": error}
    assert "refused to shut down: only root (denied)" in supervised(server, SERVER_GOES_ON).log


def test_a_shutdown_that_is_never_answered_ends_the_node_too() -> None:
    server = SimulatedServer()
    server.answers["shutdown"] = lambda _: None
    node = supervised(server)
    assert "did not answer the request to shut down" in node.log
    assert [request["action"] for request in server.requests].count("shutdown") == 1


def test_the_supervisor_ends_a_node_that_has_no_server(listener: Listener, start: Start) -> None:
    node = start(free_port())
    node.says("no server at")
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    assert "could not be told to shut down" in node.log


def test_a_limit_and_the_notes_parameter_names() -> None:
    server = SimulatedServer()
    with SimulatedNode(server, SERVER_PORT=12345, publishing_frequency=100) as node:
        samples = node.hear("sensone_sensor_data")
        node.run(0.2)
        samples.clear()
        server.paused = True
        for number in range(160):
            server.send_sample(number, monotonic_ns=server.monotonic_ns() + number * 1_250_000)
            node.settle()
        numbers = [message.data[0] for message in samples]
        assert numbers == sorted(numbers)
        assert len(numbers) in range(18, 25)
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
        ({"array_topic": "wrench"}, "no two topics one name"),
        ({"array_topic": "/diagnostics"}, "no two topics one name"),
        ({"qos_overrides.NS/wrench.publisher.reliability": "foo"}, "check qos_overrides"),
        ({"qos_overrides.NS/wrench.publisher.depth": -1}, "check qos_overrides"),
        (
            {"gravity_source": "topic_pose", "orientation.topic": "imu/data_raw"},
            "this node itself has that topic, with Imu messages and not PoseStamped",
        ),
    ],
)
def test_topics_that_cannot_be_made_are_one_sentence(
    start: Start, listener: Listener, wrong: dict[str, object], words: str
) -> None:
    node = start(12001, **{name.replace("NS", f"/{listener.tag}"): value for name, value in wrong.items()})
    assert node.ends() == 2
    lines = [line for line in node.log.splitlines() if line.startswith("bridge-client: ")]
    assert words in lines[-1]
    assert "Traceback" not in node.log


def test_arguments_that_are_not_understood(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["dance"], ["--ros-args", "-p"]):
        assert run(arguments) == 2
        said = capsys.readouterr().err
        assert said.startswith("bridge-client: ")
        assert said.count("\n") == 1


def test_without_a_home_it_says_what_to_set(
    start_process: StartProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process: rclpy is loaded once in one."""
    for name in ("HOME", "ROS_HOME", "ROS_LOG_DIR"):
        monkeypatch.delenv(name, raising=False)
    node = start_process(12001)
    assert node.ends() == 1
    assert "set HOME, or ROS_LOG_DIR to a directory for its log" in node.log.splitlines()[-1]


def test_a_signal_while_it_starts_is_no_traceback(
    server: ScriptedServer, start_process: StartProcess
) -> None:
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
