"""The node in real time: in a thread of this process or in a process of its own, and a ROS listener.

Nearly every test has `Node`. The thread is for what executors and DDS do; the process for signals,
arguments, exit codes and the middleware, and takes the two seconds that an interpreter needs to load ROS.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import rclpy
from diagnostic_msgs.msg import KeyValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from bota_ethercat_bridge.node import BridgeNode, spin
from bota_ethercat_bridge.rclpy_internals import Spinner
from tests.server.running import Program, wait_until

PATIENCE_S = 45.0
ASK_AGAIN_S = 5.0
# Nodes that are done: `destroy_node` crashes the process now and then, so they end with it.
_ENDED: list[Any] = []


def retire(node: Any) -> None:
    for kind in ("client", "publisher", "subscription", "service"):
        for entity in list(getattr(node, f"{kind}s")):
            getattr(node, f"destroy_{kind}")(entity)
    _ENDED.append(node)


class Asking:
    """Asks the node's services; `ask` is for those below: the response to a request."""

    def ask(self, service_type: Any, name: str, request: Any) -> Any:
        raise NotImplementedError

    def trigger(self, name: str) -> tuple[bool, str]:
        response = self.ask(Trigger, name, Trigger.Request())
        return response.success, response.message

    def parameters(self, *names: str) -> list[Any]:
        response = self.ask(GetParameters, "get_parameters", GetParameters.Request(names=names))
        return [parameter_value_to_python(value) for value in response.values]

    def set_parameter(self, name: str, value: Any) -> tuple[bool, str]:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        result = self.ask(SetParameters, "set_parameters", request).results[0]
        return result.successful, result.reason


class Listener(Asking):
    """A subscriber of the node's array topic, and a publisher of the supervisor's."""

    def __init__(self) -> None:
        self.tag = f"test_{uuid.uuid4().hex}"
        self.topic, self.supervisor_topic = f"/{self.tag}/array", f"/{self.tag}/supervisor"
        self.messages: queue.Queue[Any] = queue.Queue()
        self._node = rclpy.create_node(self.tag, start_parameter_services=False)
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

    def ask(
        self, service_type: Any, name: str, request: Any, until: Callable[[], object] = lambda: False
    ) -> Any:
        """The response of one of the node's services, or None once `until` holds.

        Asked again now and then, each time by a client of its own: one that is new to the service may never
        get its answers.
        """
        clients: list[Any] = []
        answer: queue.Queue[Any] = queue.Queue()
        deadline, next_ask = time.monotonic() + PATIENCE_S, 0.0
        try:
            while answer.empty() and not until():
                assert time.monotonic() < deadline, f"no answer of {name}"
                if time.monotonic() > next_ask:
                    next_ask = time.monotonic() + ASK_AGAIN_S
                    clients.append(self._node.create_client(service_type, f"/{self.tag}/bridge/{name}"))
                    assert clients[-1].wait_for_service(PATIENCE_S), f"no service {name}"
                    future = clients[-1].call_async(request)
                    future.add_done_callback(lambda future: answer.put(future.result()))
                time.sleep(0.005)
            return None if answer.empty() else answer.get()
        finally:
            for client in clients:
                self._node.destroy_client(client)

    def next_number(self) -> float:
        return float(self.messages.get(timeout=PATIENCE_S).data[0])

    def supervise(self, key: str, value: str) -> None:
        wait_until(self._supervisor.get_subscription_count, "the node's subscription")
        self._supervisor.publish(KeyValue(key=key, value=value))


class Log:
    """The node's logger: passes on to rclpy's and keeps the text, of what is throttled the first."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self.lines: list[str] = []
        self.warnings: list[str] = []
        self._throttled: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._logger, name)

    def info(self, text: str) -> None:
        self.lines.append(text)

    def warning(self, text: str, throttle_duration_sec: float = 0.0) -> None:
        if throttle_duration_sec:
            kind = text.partition("(")[0]
            if kind in self._throttled:
                return
            self._throttled.add(kind)
        self.warnings.append(text)
        self.info(text)

    error = warning


class LoggedNode(BridgeNode):
    """A node whose log can be read."""

    _log: Log | None = None

    def get_logger(self) -> Any:
        self._log = self._log or Log(super().get_logger())
        return self._log

    @property
    def text(self) -> str:
        return "\n".join(self.get_logger().lines)


class Started:
    log: str  # all that it has said

    def says(self, words: str) -> None:
        wait_until(lambda: words in self.log, f"{words!r} in the log")


class NodeThread(Started):
    """The node in a thread of this process, as `bota_ethercat_bridge.node.run` runs it."""

    def __init__(self, *arguments: str) -> None:
        self.node = LoggedNode.create(arguments)
        self.node.destroy_node = lambda: retire(self.node)
        self._ended: list[int] = []
        self._thread = threading.Thread(target=lambda: self._ended.append(spin(self.node)), daemon=True)
        self._thread.start()

    @property
    def log(self) -> str:  # type: ignore[override]
        return self.node.text

    def ends(self) -> int:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), "the node goes on"
        (exit_code,) = self._ended
        return exit_code

    def close(self) -> None:
        self.node.finish(0)
        self.ends()


class NodeProcess(Program, Started):
    """`bridge-client` in a process of its own."""

    def __init__(self, *arguments: str) -> None:
        super().__init__("bota_ethercat_bridge.client", arguments)

    @property
    def log(self) -> str:  # type: ignore[override]
        return self.said()

    def ends(self) -> int:
        return self.process.wait(PATIENCE_S)


Start = Callable[..., NodeThread]
StartProcess = Callable[..., NodeProcess]


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
