"""A ROS listener, and the node: in a thread of this process, or in a process of its own.

Nearly every test takes the thread (`start`): the same code without the two seconds that an interpreter takes
to load ROS. `start_process` is for what needs a process: signals, arguments, exit codes, the middleware.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.bridge.scripted_server import ScriptedServer

PATIENCE_S = 45.0
ASK_AGAIN_S = 5.0
AHEAD_NS = 60 * 10**9
"""Longer than any test waits."""


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Wait for something that is to happen soon."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for: {what}"
        time.sleep(0.01)


_ENDED: list[Any] = []
"""Nodes that are done: `destroy_node` crashes the process now and then, so they end with it."""


def retire(node: Any) -> None:
    """Destroy what a node has but for the node itself."""
    for client in list(node.clients):
        node.destroy_client(client)
    for publisher in list(node.publishers):
        node.destroy_publisher(publisher)
    for subscription in list(node.subscriptions):
        node.destroy_subscription(subscription)
    _ENDED.append(node)


@contextlib.contextmanager
def listening(node: Any) -> Iterator[list[BaseException]]:
    """Has those of a node's callbacks run that wait for no others; gives what they raise."""
    from bridge.spinning import OrdinaryExecutor, PromptExecutor, Spinner

    executor, raised = PromptExecutor(node), list[BaseException]()
    ordinary = OrdinaryExecutor(node, executor)  # not run, but it passes on that the node has changed
    spinner = Spinner(executor)

    def run() -> None:
        try:
            spinner.run()
        except Exception as error:  # noqa: BLE001 - for the test to see
            raised.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield raised
    finally:
        spinner.stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
        executor.shutdown()
        ordinary.shutdown()


class Listener:
    """A subscriber of the node's array topic, and a publisher of the supervisor's."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import KeyValue
        from rclpy.executors import SingleThreadedExecutor
        from std_msgs.msg import Float64MultiArray

        from bridge.spinning import Spinner

        self.tag = f"test_{uuid.uuid4().hex}"
        self.topic, self.supervisor_topic = f"/{self.tag}/array", f"/{self.tag}/supervisor"
        self.messages: queue.Queue[Any] = queue.Queue()
        self._key_value = KeyValue
        self.node = self._node = rclpy.create_node(self.tag, start_parameter_services=False)
        self._node.create_subscription(Float64MultiArray, self.topic, self.messages.put, 2000)
        self._supervisor = self._node.create_publisher(KeyValue, self.supervisor_topic, 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._spinner = Spinner(self._executor)
        self._thread = threading.Thread(target=self._spinner.run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        # The thread first: what it waits for must not be taken from under it.
        self._spinner.stop()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        self._executor.shutdown()
        retire(self._node)

    def subscribe(self, message_type: Any, topic: str, depth: int = 2000) -> queue.Queue[Any]:
        """What comes on a topic of the node's namespace from now on. A short `depth`: only what is recent."""
        messages: queue.Queue[Any] = queue.Queue()
        self._node.create_subscription(message_type, f"/{self.tag}/{topic}", messages.put, depth)
        return messages

    def call(
        self, service_type: Any, name: str, request: Any = None, until: Callable[[], object] = lambda: False
    ) -> Any:
        """The response of one of the node's services, or None once `until` holds.

        Asked again now and then: a service that is new may be seen before it sees whoever asks.
        """
        client = self._node.create_client(service_type, f"/{self.tag}/bridge/{name}")
        answer: queue.Queue[Any] = queue.Queue()
        deadline, next_ask = time.monotonic() + PATIENCE_S, 0.0
        try:
            assert client.wait_for_service(PATIENCE_S), f"no service {client.srv_name}"
            while answer.empty() and not until():
                assert time.monotonic() < deadline, f"no answer of {client.srv_name}"
                if time.monotonic() > next_ask:
                    next_ask = time.monotonic() + ASK_AGAIN_S
                    future = client.call_async(request or service_type.Request())
                    future.add_done_callback(lambda future: answer.put(future.result()))
                time.sleep(0.005)
            return None if answer.empty() else answer.get()
        finally:
            self._node.destroy_client(client)

    def trigger(self, name: str) -> tuple[bool, str]:
        """Whether a Trigger service did it, and what it says."""
        from std_srvs.srv import Trigger

        response = self.call(Trigger, name)
        return response.success, response.message

    def parameters(self, *names: str) -> list[Any]:
        """The values of the node's parameters; None is NOT_SET."""
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python

        response = self.call(GetParameters, "get_parameters", GetParameters.Request(names=names))
        return [parameter_value_to_python(value) for value in response.values]

    def set_parameter(
        self, name: str, value: Any, until: Callable[[], object] = lambda: False
    ) -> tuple[bool, str]:
        """Whether the node took the value, and why not; until `until`, as `call` has it."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        message = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        response = self.call(SetParameters, "set_parameters", request, until)
        if response is None:
            return False, "no answer"
        return response.results[0].successful, response.results[0].reason

    def next_number(self) -> float:
        """The first value of the next message: the number that the sample was made from."""
        return float(self.messages.get(timeout=PATIENCE_S).data[0])

    def numbers(self) -> list[float]:
        """The numbers of all messages that have come."""
        found = []
        while not self.messages.empty():
            found.append(float(self.messages.get().data[0]))
        return found

    def supervise(self, key: str, value: str) -> None:
        """Publish a supervisor's message as soon as the node listens."""
        wait_until(self._supervisor.get_subscription_count, "the node's subscription")
        self._supervisor.publish(self._key_value(key=key, value=value))


class Log:
    """The node's logger: passes on to rclpy's and keeps the text."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self.lines: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

    def info(self, text: str) -> None:
        self.lines.append(text)

    warning = error = info


class NodeThread:
    """The node in a thread of this process, as `bridge.node.run` runs it."""

    def __init__(self, *arguments: str) -> None:
        from bridge.node import BridgeNode, StartError, spin

        logs: list[Log] = []

        class LoggedNode(BridgeNode):
            def get_logger(self) -> Any:
                if not logs:
                    logs.append(Log(super().get_logger()))
                return logs[0]

            def destroy_node(self) -> None:
                for service in list(self.services):
                    self.destroy_service(service)
                retire(self)

        self._logs, self._lines = logs, list[str]()
        self._exit_code: int | None = None
        self._node: LoggedNode | None = None
        try:
            self._node = LoggedNode.create(arguments)
        except StartError as error:
            self._lines.append(f"bridge-client: {error}")
            self._exit_code = 2
            return
        self._thread = threading.Thread(target=self._run, args=(spin, self._node), daemon=True)
        self._thread.start()

    def _run(self, spin: Callable[[Any], int], node: Any) -> None:
        try:
            self._exit_code = spin(node)
        except BaseException as error:
            self._lines.append(f"Traceback: {error!r}")
            raise

    @property
    def node(self) -> Any:
        return self._node

    @property
    def is_running(self) -> bool:
        return self._node is not None and self._thread.is_alive()

    @property
    def log(self) -> str:
        """All that it has said."""
        return "\n".join([line for log in self._logs for line in log.lines] + self._lines)

    def says(self, words: str, times: int = 1) -> None:
        """Wait until it has said `words` that often."""
        wait_until(lambda: self.log.count(words) >= times, f"{words!r} in the log")

    def ends(self) -> int | None:
        """Wait until it has ended; its exit code."""
        if self._node is not None:
            self._thread.join(PATIENCE_S)
            assert not self._thread.is_alive(), "the node goes on"
        return self._exit_code

    def finish(self) -> None:
        """End it as a signal does."""
        if self._node is not None:
            self._node.finish(0)

    def close(self) -> None:
        self.finish()
        self.ends()


class NodeProcess:
    """`bridge-client` in a process of its own."""

    def __init__(self, *arguments: str) -> None:
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bridge.client", *arguments], stdout=self._log, stderr=subprocess.STDOUT
        )

    @property
    def is_running(self) -> bool:
        return self.process.poll() is None

    @property
    def log(self) -> str:
        """All that it has said."""
        self._log.seek(0)
        return self._log.read()

    def says(self, words: str, times: int = 1) -> None:
        """Wait until it has said `words` that often."""
        wait_until(lambda: self.log.count(words) >= times, f"{words!r} in the log")

    def ends(self) -> int:
        """Wait until it has ended; its exit code."""
        return self.process.wait(PATIENCE_S)

    def send_signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
            self.process.wait()
        self._log.close()


Start = Callable[..., NodeThread]
StartProcess = Callable[..., NodeProcess]


@pytest.fixture(scope="session")
def _ros() -> Iterator[None]:
    rclpy = pytest.importorskip(
        "rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2"
    )
    from rclpy.signals import SignalHandlerOptions

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_LOG_DIR", tempfile.gettempdir())
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    yield
    rclpy.try_shutdown()


@pytest.fixture
def listener(_ros: None) -> Iterator[Listener]:
    opened = Listener()
    yield opened
    opened.close()


@contextlib.contextmanager
def starter(listener: Listener, kind: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Gives a function that starts nodes of a kind which publish to `listener`; ends them at the end."""
    started: list[Any] = []

    def start_node(port: int, **parameters: object) -> Any:
        values = {"server_port": port, "array_topic": listener.topic, **parameters}
        options = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
        remaps = (
            f"/supervisor_status_data:={listener.supervisor_topic}",
            f"/diagnostics:=/{listener.tag}/diagnostics",
            f"__ns:=/{listener.tag}",
        )
        options += [word for remap in remaps for word in ("-r", remap)]
        started.append(kind("--ros-args", *options))
        return started[-1]

    try:
        yield start_node
    finally:
        for node in started:
            node.close()


@pytest.fixture
def start(listener: Listener) -> Iterator[Start]:
    with starter(listener, NodeThread) as start_node:
        yield start_node


@pytest.fixture
def start_process(listener: Listener) -> Iterator[StartProcess]:
    with starter(listener, NodeProcess) as start_node:
        yield start_node


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as scripted:
        yield scripted


def establish(server: ScriptedServer, listener: Listener) -> None:
    """Send samples until one arrives at the listener, then until none is on the way.

    From then on samples are dated ahead: the node skips those that it comes to read 50 ms after their time.
    """
    server.ahead_ns = AHEAD_NS
    assert server.subscribed.wait(PATIENCE_S)
    number = -1.0
    listener.numbers()
    while listener.messages.empty():
        server.send_sample(number)
        time.sleep(0.02)
    server.send_sample(-2.0)
    while listener.next_number() != -2.0:
        pass
