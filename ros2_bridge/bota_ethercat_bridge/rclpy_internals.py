# SPDX-License-Identifier: Apache-2.0
"""What the node knows of rclpy beyond its documentation: all of it is here, and each has a fallback.

Executors and parameters are used so with the versions RIGHT_FOR only. rclpy must read a message that is
serialized here as the message that is meant, whatever its version.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from operator import setitem
from struct import Struct
from typing import Any, Final

from rclpy.executors import Executor, ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from bota_ethercat.cdr import StampedNumbers

RIGHT_FOR: Final = ("7.1.", "9.1.")  # Jazzy, Kilted
_MOST_TAKEN: Final = 100  # messages of a subscription at once
_THREADS: Final = 4  # of the documented executor: a service, the supervisor, an orientation, TF


def is_known() -> bool:
    with suppress(PackageNotFoundError):
        return version("rclpy").startswith(RIGHT_FOR)
    return False


def is_about_arguments(error: Exception) -> bool:
    """Whether `rclpy.init` refused the arguments; it has no public names for these."""
    return type(error).__name__ in {"RCLInvalidROSArgsError", "UnknownROSArgsError"}


def sending(publisher: Any) -> Callable[[bytes], None]:
    """What publishes a serialized message."""
    # What `publish` calls after checks that take longer. It keeps Python's lock, so the publisher stays.
    send: Callable[[bytes], None] = publisher.handle.publish_raw if is_known() else publisher.publish
    return send


def packing(message: Any, count: int) -> Callable[..., bytes]:
    """What serializes a message of `count` float64, after a stamp (ns since 1970) if there is a header: by
    itself if rclpy reads that as `message`, but for padding; else by rclpy.
    """
    fill, numbers = filling(message), [*map(float, range(count))]
    if not hasattr(message, "header"):
        layout, pack = serialize_message(message)[: -8 * count], Struct(f"<{count}d").pack
        is_read = _is_read(layout + pack(*numbers), fill(*numbers))
        return (lambda *v: layout + pack(*v)) if is_read else lambda *v: serialize_message(fill(*v))
    packed, stamp = StampedNumbers(message.header.frame_id, count).pack, message.header.stamp

    def filled(stamp_ns: int, *values: float) -> Any:
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        return fill(*values)

    example_ns = 1_234_567_890_123_456_789
    is_read = _is_read(packed(example_ns, *numbers), filled(example_ns, *numbers))
    return packed if is_read else lambda *v: serialize_message(filled(*v))


def _is_read(serialized: bytes, message: Any) -> bool:
    with suppress(Exception):  # the middleware's
        return bool(deserialize_message(serialized, type(message)) == message)
    return False


def filling(message: Any) -> Callable[..., Any]:
    """The documented way: fills in the message's float64 in order; always the same object."""
    puts = [*_puts(message)]

    def fill(*values: float) -> Any:
        for put, value in zip(puts, values, strict=True):
            put(value)
        return message

    return fill


def _puts(part: Any) -> Iterator[Callable[[float], object]]:
    for name, kind in part.get_fields_and_field_types().items():
        value = getattr(part, name)
        if kind == "double":
            yield partial(setattr, part, name)
        elif kind.startswith(("double[", "sequence<double")):
            yield from (partial(setitem, value, index) for index in range(len(value)))
        elif hasattr(value, "get_fields_and_field_types"):
            yield from _puts(value)


class Spinner:
    """Runs an executor: `run` in one thread, `stop` from any, also before or after.

    rclpy's `spin_until_future_complete` keeps a callback for every message; `spin` and `shutdown` take the
    executor's guard condition from under a thread that waits for it.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._lock = threading.Lock()
        self._stopping = self._ended = False

    def run(self) -> None:
        """Execute callbacks until `stop`, or until the context is shut down."""
        try:
            while not self._stopping and self._executor.context.ok():
                self._executor.spin_once()
        except ExternalShutdownException:
            pass
        finally:
            with self._lock:
                self._ended = True

    def stop(self) -> None:
        """Make `run` return after the callback that it is in; then the executor may be shut down."""
        with self._lock:
            self._stopping = True
            if not self._ended:
                self._executor.create_task(lambda: None)  # something to do, so that `spin_once` returns


def taking(node: Node, *subscriptions: Any) -> Callable[[float], None]:
    """What waits, at most for so many seconds, and calls these subscriptions' callbacks with what is there.

    At the rate of a sensor an executor, which has a turn for each message, takes most of a core.
    """
    if not is_known():
        executor = SingleThreadedExecutor(context=node.context)
        executor.add_node(node)
        spin: Callable[[float], None] = executor.spin_once
        return spin
    from rclpy.impl.implementation_singleton import rclpy_implementation  # noqa: PLC0415 - of those known

    with node.context.handle:
        wait_set = rclpy_implementation.WaitSet(len(subscriptions), 0, 0, 0, 0, 0, node.context.handle)

    def take(timeout_s: float) -> None:
        wait_set.clear_entities()
        for each in subscriptions:
            wait_set.add_subscription(each.handle)
        wait_set.wait(round(timeout_s * 1e9))
        for each in subscriptions:
            for _ in range(_MOST_TAKEN):
                if (taken := each.handle.take_message(each.msg_type, each.raw)) is None:
                    break
                each.callback(taken[0])

    return take


def make_executors(node: Node, parameters: Any) -> tuple[Executor, dict[str, Executor]]:
    """One for the callbacks of the default group, which may block; by a thread's name, one for requests in
    the callback group `parameters` and one for all other groups.

    rclpy's `MultiThreadedExecutor`, which an unknown version gets, waits for all of the node's services anew
    each time: the node takes as much CPU time as with these, but 1.15 times as much with orientations at
    500 Hz. Its threads are made too late to have a priority of their own. `EventsExecutor` of rclpy 7.1 takes
    no guard conditions.
    """
    if is_known():
        ordinary = node.default_callback_group
        beside = {
            "listener": _PartExecutor(node, lambda group: group not in (ordinary, parameters)),
            "parameters": _PartExecutor(node, lambda group: group is parameters),
        }
        return _PartExecutor(node, lambda group: group is ordinary, *beside.values()), {**beside}
    text = "this version of rclpy is not known: its MultiThreadedExecutor is used, which takes more CPU"
    node.get_logger().info(text)
    executor = MultiThreadedExecutor(_THREADS, context=node.context)
    executor.add_node(node)
    return executor, {}


class _PartExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy has no types
    """For those of a node's callbacks whose groups it wants."""

    def __init__(self, node: Node, wants: Callable[[Any], bool], *others: _PartExecutor) -> None:
        self._others = others
        super().__init__(context=node.context)
        self._part = _Part(node, wants)
        if others:
            self.add_node(node)

    def get_nodes(self) -> list[Any]:
        return [self._part]

    def wake(self) -> None:
        super().wake()
        for other in self._others:
            other.wake()


class _Part:
    def __init__(self, node: Node, wants: Callable[[Any], bool]) -> None:
        self._node, self._wants = node, wants

    def __getattr__(self, kind: str) -> Any:
        """`subscriptions`, `timers`, `clients`, `services`, `guards` or `waitables`."""
        return [entity for entity in getattr(self._node, kind) if self._wants(entity.callback_group)]


def given_parameters(node: Node) -> list[str]:
    """The names of all that were given to the node, declared or not; of an unknown version, none."""
    return [*node._parameter_overrides] if is_known() else []


def refuse_what_raises(node: Node) -> None:
    """Grant nothing where rclpy raises, which would end the node: unknown types of parameters, transitions
    that a state does not have."""

    def refuse(act: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        with suppress(ValueError, RuntimeError):
            return act(request, response)
        return response

    for service in node.services if is_known() else ():
        service.callback = partial(refuse, service.callback)
