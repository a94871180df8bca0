"""Runs an executor until it is told to stop, from any thread; and one node in two of them.

Not with rclpy's `spin_until_future_complete`: that keeps a callback for every message it has handled. Nor
with `spin` and `shutdown`: that takes the executor's guard condition from under a thread that waits for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


class Spinner:
    """`run` in one thread, `stop` from any, also before or after. Then the executor may be shut down."""

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
        """Make `run` return after the callback that it is in."""
        with self._lock:
            self._stopping = True
            if not self._ended:
                self._executor.create_task(_wake)


def _wake() -> None:
    """Something to do, so that `spin_once` returns."""


class PromptExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy has no types
    """For the callbacks of a node that are in a callback group of their own: they wait for no others.

    rclpy has `MultiThreadedExecutor` for that, which hands every callback to a pool and waits for all of the
    node's services anew each time: too much beside the reader, for an orientation 500 times a second.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        default = node.default_callback_group
        self._part = _Part(node, lambda group: group is not default)

    def get_nodes(self) -> list[Any]:
        """The node's entities that are for this executor."""
        return [self._part]


class OrdinaryExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """For all others of the node's callbacks, which may block. It is the executor that the node knows."""

    def __init__(self, node: Node, prompt: PromptExecutor) -> None:
        self._prompt = prompt
        super().__init__(context=node.context)
        default = node.default_callback_group
        self._part = _Part(node, lambda group: group is default)
        self.add_node(node)

    def get_nodes(self) -> list[Any]:
        """The node's entities that are for this executor."""
        return [self._part]

    def wake(self) -> None:
        """Wake both: the node has another entity, or one less."""
        super().wake()
        self._prompt.wake()


class _Part:
    """A node as an executor sees it, with some of its entities."""

    def __init__(self, node: Node, is_mine: Callable[[Any], bool]) -> None:
        self._node, self._is_mine = node, is_mine

    def _mine(self, entities: Iterable[Any]) -> list[Any]:
        return [entity for entity in entities if self._is_mine(entity.callback_group)]

    subscriptions = property(lambda self: self._mine(self._node.subscriptions))
    timers = property(lambda self: self._mine(self._node.timers))
    clients = property(lambda self: self._mine(self._node.clients))
    services = property(lambda self: self._mine(self._node.services))
    guards = property(lambda self: self._mine(self._node.guards))
    waitables = property(lambda self: self._mine(self._node.waitables))
