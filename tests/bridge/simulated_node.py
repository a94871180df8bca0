"""The whole node in memory and in simulated time: rclpy's node with its parameters, without DDS and sockets.

    server = Server()
    with Node(server, tool_mass=0.8) as node:
        wrenches = node.hear("wrench_compensated")
        node.run(1.0)  # simulated seconds
        assert node.trigger("tare") == (True, ...)
        node.until("7 samples lost", stream="warn")

Time passes in `run`, and while a service waits for something: it is called as the executor would call it.
There is one thread, so the same test gives the same run.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import math
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message, serialize_message

from bota_ethercat.control import Event, event
from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.pdo import encode
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat_bridge.diagnostics import TICK_S
from bota_ethercat_bridge.parameters.table import PARAMETERS, gather
from bota_ft_compensation.quantities import NO_WRENCH, Payload, Wrench
from tests.bridge.real_node import PATIENCE_S, Asking, LoggedNode, retire
from tests.bridge.scripted_server import MemoryServer, ScriptedChannel
from tests.compensation.making import TOOL, load
from tests.descriptions import description, sensor_row

HEALTHY = dict.fromkeys(("link", "stream", "sensor", "clock", "compensation"), "ok")
RATE_HZ = 100
SETTINGS: JsonObject = {"sinc_length": 512, "fir": False, "acceleration_range_g": 2}
UP, SIDE, OVER = (0, 0, 1), (1, 0, 0), (0, 0, -1)
ZERO6 = [0.0] * 6
QUICK: dict[str, object] = {"rest.duration": 0.3, "bias_ramp_time": 0.0}
DEFAULTS = gather({row.name: row.default for row in PARAMETERS})
TURNS = itertools.count()
STEP_S = 0.01  # time passes in steps of this length: a sample each


def status(lost_samples: int = 0, mode: str = "locked") -> JsonObject:
    spread = {"p50": 10.0, "p99": 20.0, "p999": 30.0, "max": 40.0}
    clock = {"mode": mode, "period_us": 10000.0, "offset_ppm": 1.0, "uncertainty_us": 5.0}
    return {
        "ok": True, "cycles": 1, "missed_deadlines": 2, "lost_frames": 3, "wake_us": spread,
        "exchange_us": spread, "uptime_s": 4.0, "clients": [],
        "last_10s": {"wake_us": spread, "exchange_us": spread, "age_us": [spread]},
        "sensors": [
            {"sensor": 0, "lost_samples": lost_samples, "not_finite": 0, "recoveries": 1, "clock": clock}
        ],
    }  # fmt: skip


class Server(MemoryServer):
    """Samples once a step, as long as it is not `paused`: with `changes`, but for what comes `once`."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns, self.clock_step_ns = 5 * 10**9, 0  # the step: by how much the wall clock has been set
        self.pass_step = self.step  # what who waits does, until the time has come
        self.description = description(sensor_row(rate_hz=RATE_HZ, settings=dict(SETTINGS)))
        self.answers["status"] = lambda _: status()
        self.changes: dict[str, Any] = {}
        self.paused = False
        self.sent = 0
        self._once: deque[dict[str, Any]] = deque()

    def time_ns(self) -> int:
        return 10**18 + self.now_ns + self.clock_step_ns

    def wait(self, event: threading.Event, seconds: float) -> bool:
        due_ns = self.now_ns + round(seconds * 1e9)
        while not event.is_set() and self.now_ns < due_ns:
            self.pass_step()
        return event.is_set()

    def once(self, **changes: Any) -> None:
        self._once.append(changes)

    def forget_once(self) -> None:
        self._once.clear()

    def reconfigure(self, **changed: Any) -> None:
        values = {name: changed.pop(name) for name in ("rate_hz", "delay_ms") if name in changed}
        self.send_json(event(Event.RECONFIGURED, sensor=0, settings={**SETTINGS, **changed}, **values))

    def hold(self, up: Sequence[float], **changes: Any) -> None:
        self.changes = {"process_data": sensed(up, **changes)}

    def step(self) -> None:
        self.now_ns += round(STEP_S * 1e9)
        if self.subscribed.is_set() and not self.paused:
            self.send_sample(float(self.sent), **(self._once.popleft() if self._once else self.changes))
            self.sent += 1


class Topic:
    """A publisher of the node's that keeps what is published, while the test hears it."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher
        self.handle = SimpleNamespace(publish_raw=self.publish)
        self.is_heard = False
        self.messages: list[Any] = []
        self.serialized: list[bytes] = []
        self.turn = 0  # of the latest message, counted over all topics

    def __getattr__(self, name: str) -> Any:
        return getattr(self._publisher, name)

    def get_subscription_count(self) -> int:
        return int(self.is_heard)

    def publish(self, message: Any) -> None:
        self._publisher.get_subscription_count()  # InvalidHandle once it is destroyed
        self.turn = next(TURNS)
        serialized = message
        if isinstance(message, bytes):
            message = deserialize_message(message, self._publisher.msg_type)
        elif self.is_heard:
            serialized = serialize_message(message)
        if self.is_heard:
            self.messages.append(copy.deepcopy(message))
            self.serialized.append(serialized)


class Guard:
    """A guard condition whose callback waits for the executor: for the test."""

    def __init__(self, callback: Callable[[], object], triggered: list[Callable[[], object]]) -> None:
        self._callback, self._triggered = callback, triggered

    def trigger(self) -> None:
        if self._callback not in self._triggered:
            self._triggered.append(self._callback)


class Node(Asking):
    """A node that is connected to `server` as soon as time passes. StartError if it cannot start."""

    def __init__(self, server: Server, *arguments: str, **parameters: object) -> None:
        self.name = f"/test_{uuid.uuid4().hex}/bridge"
        self.topics: dict[str, Topic] = {}
        self._triggered = list[Callable[[], object]]()
        self.stand_ins: list[Any] = []
        self.server, self._tick_ns, self._is_busy = server, 0, False
        self._agenda: list[tuple[int, Callable[[], object]]] = []
        server.pass_step, bench = self.step, self

        class Bridge(LoggedNode):
            clock: Any = server
            channel = ScriptedChannel(server)

            def create_publisher(self, *arguments: Any, **options: Any) -> Any:
                topic = Topic(super().create_publisher(*arguments, **options))
                return bench.topics.setdefault(topic.topic_name, topic)

            def destroy_publisher(self, publisher: Any) -> bool:
                return bool(super().destroy_publisher(getattr(publisher, "_publisher", publisher)))

            def create_service(self, kind: Any, name: str, callback: Any, **options: Any) -> Any:
                if hasattr(kind, "_TYPE_SUPPORT"):
                    return super().create_service(kind, name, callback, **options)
                full = name.replace("~", bench.name)  # ROS has no stand-ins
                stand_in = SimpleNamespace(srv_type=kind, service_name=full, callback=callback)
                bench.stand_ins.append(stand_in)
                return stand_in

            def create_guard_condition(self, callback: Callable[[], object], *_: Any) -> Any:
                return Guard(callback, bench._triggered)

        options = [word for item in parameters.items() for word in ("-p", "{}:={}".format(*item))]
        namespace = self.name.removesuffix("/bridge")
        self.node = Bridge.create(["--ros-args", "-r", f"__ns:={namespace}", *arguments, *options])
        self._arrays = self.hear("/diagnostics")
        self.settle()

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        assert self.node.exit_code != 1, self.log
        self.node.reader.client.close()
        self.node.compensation.stop()
        retire(self.node)

    @property
    def log(self) -> str:
        return self.node.text

    # -- time

    def at(self, seconds: float, action: Callable[[], object]) -> None:
        self._agenda.append((self.server.now_ns + round(seconds * 1e9), action))

    def step(self) -> None:
        for due in [due for due in self._agenda if due[0] <= self.server.now_ns]:
            self._agenda.remove(due)
            due[1]()
        self.server.step()
        for timer in list(self.node.timers):
            timer.callback()  # as an executor would call it
        self.settle()
        if self.server.now_ns >= self._tick_ns:
            self._tick_ns = self.server.now_ns + round(TICK_S * 1e9)
            self.node.monitor.tick()

    def settle(self) -> None:
        reader = self.node.reader
        with contextlib.suppress(ConnectionFailedError):  # the node has been told to end
            reader.read(0.0)
            while self.server.arrived:
                reader.read(0.0)
        reader.client._reader = None  # who asks the server waits as another thread does
        while self._triggered and not self._is_busy:
            self._triggered.pop(0)()

    def run(self, seconds: float) -> None:
        end_s = self.server.monotonic() + seconds - STEP_S / 2
        while self.server.monotonic() < end_s:
            self.step()

    def fresh(self, messages: list[Any], seconds: float) -> list[Any]:
        messages.clear()
        self.run(seconds)
        return messages

    def run_until(self, condition: Callable[[], object], what: Callable[[], str] | str) -> None:
        end_s = self.server.monotonic() + PATIENCE_S
        while not condition():
            if self.server.monotonic() > end_s:
                raise AssertionError(f"waited in vain for: {what if isinstance(what, str) else what()}")
            self.step()

    # -- services and parameters

    def call(self, name: str, request: Any) -> Any:
        offered = [*self.node.services, *self.stand_ins]
        (service,) = [found for found in offered if found.service_name == f"{self.name}/{name}"]
        with self.busy():
            response = service.callback(request, service.srv_type.Response())
        self.settle()
        return response

    @contextlib.contextmanager
    def busy(self) -> Iterator[None]:
        """The executor does not get to what is triggered meanwhile."""
        was, self._is_busy = self._is_busy, True
        try:
            yield
        finally:
            self._is_busy = was

    def ask(self, service_type: Any, name: str, request: Any) -> Any:
        return self.call(name, request)

    def do(self, name: str, *words: str, done: bool = True) -> str:
        did, text = self.trigger(name)
        assert did is done, text
        assert [word for word in words if word not in text] == [], text
        return text

    def refuse(self, name: str, *words: str) -> str:
        return self.do(name, *words, done=False)

    def set(self, name: str, value: Any) -> None:
        assert self.set_parameter(name, value) == (True, "")

    def refuse_value(self, name: str, value: Any, *words: str) -> None:
        done, reason = self.set_parameter(name, value)
        assert not done
        assert [word for word in words if word not in reason] == [], reason

    # -- topics

    def hear(self, topic: str) -> list[Any]:
        heard = self.topics[topic if topic.startswith("/") else f"{self.name.removesuffix('bridge')}{topic}"]
        heard.is_heard = True
        return heard.messages

    def unhear(self, topic: str) -> None:
        self.topics[f"{self.name.removesuffix('bridge')}{topic}"].is_heard = False

    def latest(self) -> dict[str, Any]:
        return self._named(self._arrays[-1])

    def statuses(self) -> dict[str, Any]:
        """The next array of /diagnostics: {short name: status}."""
        self._arrays.clear()
        self.run_until(lambda: self._arrays, "diagnostics")
        return self.latest()

    def until(self, *words: str, **levels: str) -> dict[str, Any]:
        """The first array in which these statuses have these levels and their messages hold these words."""
        self._arrays.clear()
        found: dict[str, Any] = {}

        def is_so() -> bool:
            while self._arrays:
                found.update(self._named(self._arrays.pop(0)))
                said = " ".join(found[name].message for name in levels)
                if {name: level(found[name]) for name in levels} == levels and all(w in said for w in words):
                    return True
            return False

        self.run_until(is_so, lambda: f"{levels} {words}; last: {[one.message for one in found.values()]}")
        return found

    def _named(self, array: DiagnosticArray) -> dict[str, Any]:
        prefix = f"{self.name[1:]}: "
        assert all(status.name.startswith(prefix) for status in array.status)
        return {status.name.removeprefix(prefix): status for status in array.status}


def sensed(
    up: Sequence[float],
    payload: Payload = TOOL,
    bias: Wrench = NO_WRENCH,
    size: int = 61,
    **changes: float,
) -> bytes:
    """Process data of a sensor at rest with `up` pointing up. `changes` are added: `force_x=1.0`, ..."""
    names = [f"{quantity}.{axis}" for quantity in ("force", "torque", "acceleration") for axis in "xyz"]
    length = math.sqrt(sum(part * part for part in up))
    values = dict(zip(names, [*load(up, payload, bias).values, *(part / length for part in up)], strict=True))
    for name, change in changes.items():
        field = ".".join(name.rsplit("_", 1))
        values[field] = values.get(field, 0.0) + change
    return encode(size, values)


class Stages:
    def __init__(self, node: Node) -> None:
        self._node = node
        names = ("wrench_compensated", "compensation/bias", "compensation/tool")
        self.all = self.final, self.bias, self.tool = [node.hear(name) for name in names]

    def forget(self) -> None:
        for messages in self.all:
            messages.clear()

    def first(self) -> list[float]:
        self._node.run_until(lambda: self.final, "wrench_compensated")
        return six(self.final[0])

    def settle(self, wanted: Sequence[float], within: float = 1e-3) -> None:
        self.forget()
        self._node.run_until(
            lambda: self.final and is_near(self.final[-1], wanted, within),
            lambda: f"{wanted}; last: {six(self.final[-1]) if self.final else None}",
        )

    def at(
        self, up: Sequence[float], wanted: Sequence[float] = ZERO6, within: float = 1e-3, **changes: Any
    ) -> None:
        self._node.server.hold(up, **changes)
        self.settle(wanted, within)

    def are_silent(self) -> bool:
        self.forget()
        self._node.run(0.5)
        return not any(self.all)


def six(message: Any) -> list[float]:
    f, m = message.wrench.force, message.wrench.torque
    return [f.x, f.y, f.z, m.x, m.y, m.z]


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def is_near(message: Any, wanted: Sequence[float], within: float = 1e-3) -> bool:
    return all(abs(a - b) <= within for a, b in zip(six(message), wanted, strict=True))


def weight(up: Sequence[float], payload: Payload = TOOL) -> list[float]:
    return list(load(up, payload, NO_WRENCH).values)


def values(status: Any) -> dict[str, str]:
    return {value.key: value.value for value in status.values}


def level(status: Any) -> str:
    return ("ok", "warn", "error", "stale")[status.level[0]]
