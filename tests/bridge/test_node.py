"""How the node starts, waits for its server, finds it again, and ends."""

from __future__ import annotations

import os
import signal
import time

import pytest

from tests.bridge.conftest import Listener, NodeProcess, Start, StartProcess, establish, wait_until
from tests.bridge.scripted_server import ScriptedServer

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("_ros")]


def free_port() -> int:
    """A port that nobody listens on."""
    with ScriptedServer() as gone:
        return gone.port


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_with_exit_code_0(
    server: ScriptedServer, start_process: StartProcess, number: signal.Signals
) -> None:
    """In a process: signals are a process's."""
    node = start_process(server.port)
    node.says("connected to")
    node.send_signal(number)
    assert node.ends() == 0
    assert "Traceback" not in node.log
    assert server.disconnected.wait(10)


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
    time.sleep(0.5)
    assert node.log.count("no server at") == 1, "said once, not at every attempt"
    assert node.log.count("connected again") == 1
    node.finish()
    assert node.ends() == 0


def test_the_supervisor_shuts_the_server_down_and_ends_the_node(
    server: ScriptedServer, listener: Listener, start: Start
) -> None:
    node = start(server.port)
    node.says("connected to")
    for key, value in (("ft_sensors", "0"), ("camera", "1"), ("ft_sensors", "11")):
        listener.supervise(key, value)
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    actions = [request["action"] for request in server.requests]
    assert actions[:2] == ["describe", "subscribe"]
    assert actions.count("shutdown") == 1
    assert "is shutting down" in node.log


def test_a_refused_shutdown_is_said_and_ends_the_node_too(
    server: ScriptedServer, listener: Listener, start: Start
) -> None:
    error = {"code": "denied", "message": "only root"}
    server.answers["shutdown"] = lambda _: {"ok": False, "error": error}
    node = start(server.port)
    node.says("connected to")
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    assert "refused to shut down: only root (denied)" in node.log


def test_a_shutdown_that_is_never_answered_ends_the_node_too(
    server: ScriptedServer, listener: Listener, start: Start
) -> None:
    server.answers["shutdown"] = lambda _: None
    node = start(server.port)
    node.says("connected to")
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    assert "did not answer" in node.log


def test_the_supervisor_ends_a_node_that_has_no_server(listener: Listener, start: Start) -> None:
    node = start(free_port())
    node.says("no server at")
    listener.supervise("ft_sensors", "1")
    assert node.ends() == 0
    assert "could not be told to shut down" in node.log


def test_a_limit_and_the_notes_parameter_names(listener: Listener, start: Start) -> None:
    with ScriptedServer() as server:
        # server_port is left at its default here.
        node = start(12001, SERVER_PORT=server.port, publishing_frequency=100)
        establish(server, listener)
        time.sleep(0.05)
        at = time.monotonic_ns() + server.ahead_ns
        for number in range(160):
            server.send_sample(number, monotonic_ns=at + number * 1_250_000)
        server.send_sample(1000.0, monotonic_ns=at + 10**9)
        numbers = []
        while 1000.0 not in numbers:
            numbers.append(listener.next_number())
        assert numbers == sorted(numbers)
        assert len(numbers) <= 24
        assert listener.parameters("server_port", "SERVER_PORT") == [server.port, server.port]
        node.finish()
        assert node.ends() == 0


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
            {"orientation_source": "topic_pose", "orientation.topic": "imu/data_raw"},
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


def test_a_wrong_setting_at_start_is_one_sentence(start: Start) -> None:
    node = start(12001, **{"settings.acceleration_range_g": 3})
    assert node.ends() == 2
    (line,) = node.log.splitlines()
    assert line.startswith("bridge-client: parameter settings.acceleration_range_g: ")
    assert "2, 4, 8, 16" in line


def test_arguments_that_are_not_understood() -> None:
    """In processes: it is about the command line."""
    for arguments, code in ((("dance",), 2), (("--ros-args", "-p"), 2), (("--help",), 0)):
        node = NodeProcess(*arguments)
        assert node.ends() == code
        assert "Traceback" not in node.log
        node.close()


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
