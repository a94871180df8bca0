"""The whole node in memory and in simulated time: rclpy's node with its parameters, without DDS and sockets.

    server = SimulatedServer()
    with SimulatedNode(server, tool_mass=0.8) as node:
        wrenches = node.hear("wrench_compensated")
        node.run(1.0)  # simulated seconds
        assert node.trigger("tare") == (True, ...)
        node.until("7 samples lost", stream=WARN)

Time passes in `run`, and while a service waits for something: it is called as the executor would call it. The
reader runs in its thread, but only while the test waits for it: the same test gives the same run.
"""

from __future__ import annotations

import threading
import uuid
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from bota_ethercat.errors import ConnectionFailedError, UnreachableError
from bota_ethercat.framing import FrameDecoder
from bridge.diagnostics.monitor import TICK_S
from bridge.node import BridgeNode
from tests.bridge.conftest import PATIENCE_S, Log, retire
from tests.bridge.scripted_server import Script
from tests.bridge.streaming import status, streaming_description

STEP_S = 0.01
"""Time passes in steps of this length: a sample each."""


class World(Protocol):
    """What a node lives in: time, and a server."""

    def monotonic_ns(self) -> int: ...

    def time_ns(self) -> int: ...

    def accept(self, wire: Wire) -> Callable[[bytes], object]:
        """Take a connection of the node's; returns where its bytes go. UnreachableError if nobody listens."""

    def step(self) -> None:
        """STEP_S pass."""


class Turns:
    """Two threads, one at a time: the reader runs while the test waits until it has nothing to do."""

    def __init__(self) -> None:
        self.over = False
        self._changed = threading.Condition()
        self._awaited: Callable[[], bool] | None = None

    def block(self, awaited: Callable[[], bool]) -> None:
        """For the reader: wait until something is so."""
        with self._changed:
            self._awaited = awaited
            self._changed.notify_all()
            self._changed.wait_for(lambda: awaited() or self.over)
            self._awaited = None

    def settle(self) -> None:
        """For the test: let the reader do what there is to do."""
        with self._changed:
            self._changed.notify_all()
            waits = self._changed.wait_for(lambda: self._awaited and not self._awaited(), PATIENCE_S)
            assert waits, "the reader does not come to rest, or has ended"

    def end(self) -> None:
        with self._changed:
            self.over = True
            self._changed.notify_all()


class Wire:
    """A `Channel` in memory; `feed` and `end` are for its other end."""

    is_near = True
    own = ("memory", 0)

    def __init__(self, world: World, turns: Turns, clock: SimulatedClock) -> None:
        self.monotonic_ns, self.wait = clock.monotonic_ns, clock.wait
        self._world, self._turns = world, turns
        self._arrived, self._ended = bytearray(), True
        self._send: Callable[[bytes], object] = lambda _: None

    def connect(self, timeout_s: float) -> bool:
        self._send = self._world.accept(self)
        self._ended = False
        return True

    def feed(self, data: bytes) -> None:
        self._arrived += data

    def end(self) -> None:
        self._ended = True

    shutdown = end

    def close(self) -> None:
        self.end()
        self._arrived.clear()

    def fileno(self) -> int:
        return -1

    def send(self, data: bytes) -> None:
        if self._ended:
            raise ConnectionFailedError("cannot send: Broken pipe")
        self._send(data)

    def receive(self, buffer: memoryview, timeout_s: float) -> int:
        if timeout_s > 0:
            due_ns = self.monotonic_ns() + round(timeout_s * 1e9)
            self._turns.block(lambda: bool(self._arrived) or self._ended or self.monotonic_ns() >= due_ns)
        if not self._arrived and (self._ended or self._turns.over):
            raise ConnectionFailedError("the server closed it")
        data = self._arrived[: len(buffer)]
        buffer[: len(data)] = data
        del self._arrived[: len(data)]
        return len(data)


class SimulatedServer(Script):
    """Samples once a step, as long as it is not `paused`: with `changes`, but for what comes `once`."""

    def __init__(self) -> None:
        self._now_ns = 5 * 10**9
        super().__init__(self)
        self.description = streaming_description()
        self.answers["status"] = lambda _: status()
        self.changes: dict[str, Any] = {}
        self.paused = False
        self.listens = True
        self.sent = 0
        self._once: deque[dict[str, Any]] = deque()
        self._wire: Wire | None = None

    def monotonic_ns(self) -> int:
        return self._now_ns

    def time_ns(self) -> int:
        return 10**18 + self._now_ns

    def accept(self, wire: Wire) -> Callable[[bytes], object]:
        if not self.listens:
            raise UnreachableError("Connection refused")
        self.connections += 1
        self._wire, decoder = wire, FrameDecoder()
        return lambda data: self.receive(decoder, data)

    def send_raw(self, data: bytes) -> None:
        assert self._wire is not None
        self._wire.feed(data)

    def once(self, **changes: Any) -> None:
        """The next sample, and no other, is so."""
        self._once.append(changes)

    def forget_once(self) -> None:
        """Forget what was to come once."""
        self._once.clear()

    def drop(self) -> None:
        """Drop the connection."""
        self.subscribed.clear()
        assert self._wire is not None
        self._wire.end()

    def step(self) -> None:
        self._now_ns += round(STEP_S * 1e9)
        if self.subscribed.is_set() and not self.paused:
            self.send_sample(float(self.sent), **(self._once.popleft() if self._once else self.changes))
            self.sent += 1


class SimulatedClock:
    """The node's clock: who waits in the reader's thread lets the test go on, who waits in the test's lets
    time pass."""

    def __init__(self, world: World, turns: Turns, step: Callable[[], None]) -> None:
        self.monotonic_ns, self.time_ns = world.monotonic_ns, world.time_ns
        self._turns, self._step = turns, step
        self._test = threading.current_thread()

    def monotonic(self) -> float:
        return self.monotonic_ns() / 1e9

    def wait(self, event: threading.Event, seconds: float, /) -> bool:
        due_s = self.monotonic() + seconds

        def over() -> bool:
            return event.is_set() or self.monotonic() >= due_s

        if threading.current_thread() is not self._test:
            self._turns.block(over)
        else:
            while not over():
                self._step()
        return event.is_set()


class Topic:
    """A publisher of the node's that keeps what is published, while the test hears it."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher
        self.is_heard = False
        self.messages: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._publisher, name)

    def get_subscription_count(self) -> int:
        return int(self.is_heard)

    def publish(self, message: Any) -> None:
        if isinstance(message, bytes):
            message = deserialize_message(message, self._publisher.msg_type)
        if self.is_heard:
            self.messages.append(message)


class Guard:
    """A guard condition whose callback waits for the executor: for the test."""

    def __init__(self, callback: Callable[[], object], triggered: list[Callable[[], object]]) -> None:
        self._callback, self._triggered = callback, triggered

    def trigger(self) -> None:
        if self._callback not in self._triggered:
            self._triggered.append(self._callback)


class SimulatedNode:
    """A node that is connected to `server` as soon as time passes. StartError if it cannot start."""

    def __init__(self, server: World, *arguments: str, **parameters: object) -> None:
        self.name = f"/test_{uuid.uuid4().hex}/bridge"
        self.topics: dict[str, Topic] = {}
        self._turns, self._triggered = Turns(), list[Callable[[], object]]()
        self._server, self._tick_ns, self._is_busy = server, 0, False
        self._agenda: list[tuple[int, Callable[[], object]]] = []
        self._clock = SimulatedClock(server, self._turns, self.step)
        logs: list[Log] = []
        bench = self

        class Bridge(BridgeNode):
            clock = self._clock
            channel = Wire(server, self._turns, self._clock)

            def get_logger(self) -> Any:
                if not logs:
                    logs.append(Log(super().get_logger()))
                return logs[0]

            def create_publisher(self, *arguments: Any, **options: Any) -> Any:
                topic = Topic(super().create_publisher(*arguments, **options))
                return bench.topics.setdefault(topic.topic_name, topic)

            def create_guard_condition(self, callback: Callable[[], object], *_: Any) -> Any:
                return Guard(callback, bench._triggered)

        options = [word for item in parameters.items() for word in ("-p", "{}:={}".format(*item))]
        namespace = self.name.removesuffix("/bridge")
        self.node = Bridge.create(["--ros-args", "-r", f"__ns:={namespace}", *arguments, *options])
        self._lines = logs[0].lines
        self._arrays = self.hear("/diagnostics")
        self.node.reader.start()
        self.settle()

    def __enter__(self) -> SimulatedNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        assert self.node.exit_code != 1, self.log
        self._turns.end()
        assert self.node.reader.stop(PATIENCE_S)
        self.node.compensation.close()
        for service in list(self.node.services):
            self.node.destroy_service(service)
        retire(self.node)

    @property
    def log(self) -> str:
        """All that it has said."""
        return "\n".join(self._lines)

    # -- time

    def at(self, seconds: float, action: Callable[[], object]) -> None:
        """Do something so many seconds from now."""
        self._agenda.append((self._server.monotonic_ns() + round(seconds * 1e9), action))

    def step(self) -> None:
        """Let STEP_S pass."""
        for due in [due for due in self._agenda if due[0] <= self._server.monotonic_ns()]:
            self._agenda.remove(due)
            due[1]()
        self._server.step()
        self.settle()
        if self._server.monotonic_ns() >= self._tick_ns:
            self._tick_ns = self._server.monotonic_ns() + round(TICK_S * 1e9)
            self.node.monitor.tick()

    def settle(self) -> None:
        """Let the node do what there is to do now."""
        if self.node.exit_code is None:  # else its client is closed, and its reader ends
            self._turns.settle()
        while self._triggered and not self._is_busy:
            self._triggered.pop(0)()

    def run(self, seconds: float) -> None:
        """Let so much simulated time pass."""
        end_s = self._clock.monotonic() + seconds - STEP_S / 2
        while self._clock.monotonic() < end_s:
            self.step()

    def run_until(self, condition: Callable[[], object], what: Callable[[], str] | str) -> None:
        """Let time pass until something is so."""
        end_s = self._clock.monotonic() + PATIENCE_S
        while not condition():
            if self._clock.monotonic() > end_s:
                raise AssertionError(f"waited in vain for: {what if isinstance(what, str) else what()}")
            self.step()

    # -- services and parameters

    def call(self, name: str, request: Any) -> Any:
        """The response of one of the node's services."""
        (service,) = [found for found in self.node.services if found.service_name == f"{self.name}/{name}"]
        self._is_busy = True
        try:
            response = service.callback(request, service.srv_type.Response())
        finally:
            self._is_busy = False
        self.settle()
        return response

    def trigger(self, name: str) -> tuple[bool, str]:
        """Whether a Trigger service did it, and what it says."""
        response = self.call(name, Trigger.Request())
        return response.success, response.message

    def parameters(self, *names: str) -> list[Any]:
        """The values of the node's parameters; None is NOT_SET."""
        response = self.call("get_parameters", GetParameters.Request(names=names))
        return [parameter_value_to_python(value) for value in response.values]

    def set_parameter(self, name: str, value: Any) -> tuple[bool, str]:
        """Whether the node took the value, and why not."""
        message = Parameter(name, value=value).to_parameter_msg()
        result = self.call("set_parameters", SetParameters.Request(parameters=[message])).results[0]
        return result.successful, result.reason

    # -- topics

    def hear(self, topic: str) -> list[Any]:
        """What is published on a topic of the node's namespace from now on."""
        heard = self.topics[topic if topic.startswith("/") else f"{self.name.removesuffix('bridge')}{topic}"]
        heard.is_heard = True
        return heard.messages

    def statuses(self) -> dict[str, Any]:
        """The next array of /diagnostics: {short name: status}."""
        self._arrays.clear()
        self.run_until(lambda: self._arrays, "diagnostics")
        return self._named(self._arrays[-1])

    def until(self, *words: str, **levels: int) -> dict[str, Any]:
        """The first array in which these statuses have these levels and their messages hold these words."""
        self._arrays.clear()
        found: dict[str, Any] = {}

        def is_so() -> bool:
            while self._arrays:
                found.update(self._named(self._arrays.pop(0)))
                said = " ".join(found[name].message for name in levels)
                if {name: found[name].level[0] for name in levels} == levels and all(
                    w in said for w in words
                ):
                    return True
            return False

        self.run_until(is_so, lambda: f"{levels} {words}; last: {[one.message for one in found.values()]}")
        return found

    def _named(self, array: DiagnosticArray) -> dict[str, Any]:
        prefix = f"{self.name[1:]}: "
        assert all(status.name.startswith(prefix) for status in array.status)
        return {status.name.removeprefix(prefix): status for status in array.status}
