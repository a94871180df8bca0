"""Runs an executor until it is told to stop, from any thread; and one node in several of them.

Not with rclpy's `spin_until_future_complete`: that keeps a callback for every message it has handled. Nor
with `spin` and `shutdown`: that takes the executor's guard condition from under a thread that waits for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
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
                self._executor.create_task(lambda: None)  # something to do, so that `spin_once` returns


class PartExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy has no types
    """For those of a node's callbacks whose groups it wants: they wait for no others.

    rclpy has `MultiThreadedExecutor` for that, which hands every callback to a pool and waits for all of the
    node's services anew each time: too much beside the reader, for an orientation 500 times a second.
    """

    def __init__(self, node: Node, wants: Callable[[Any], bool], *others: PartExecutor) -> None:
        """With the `others` it is the one that the node knows."""
        self._others = others
        super().__init__(context=node.context)
        self._part = _Part(node, wants)
        if others:
            self.add_node(node)

    def get_nodes(self) -> list[Any]:
        """The node's entities that are for this executor."""
        return [self._part]

    def wake(self) -> None:
        """Wake all: the node has another entity, or one less."""
        super().wake()
        for other in self._others:
            other.wake()


class _Part:
    """A node as an executor sees it, with the entities whose callback groups it wants."""

    def __init__(self, node: Node, wants: Callable[[Any], bool]) -> None:
        self._node, self._wants = node, wants

    def __getattr__(self, kind: str) -> Any:
        """`subscriptions`, `timers`, `clients`, `services`, `guards` or `waitables`."""
        return [entity for entity in getattr(self._node, kind) if self._wants(entity.callback_group)]
