"""The executor runs until it is told to stop, whenever that is, and keeps nothing of what it has handled."""

from __future__ import annotations

import gc
import threading
import types
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="rclpy is missing: pip install the extra 'ros' or source ROS 2")

import rclpy
from rclpy.executors import SingleThreadedExecutor

from bridge.spinning import Spinner
from tests.bridge.conftest import PATIENCE_S

pytestmark = pytest.mark.ros


class Bench:
    """A node with a fast timer, and a spinner in a thread."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("spinning")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.spinner = Spinner(self.executor)
        self.ticks = 0
        self.wanted = 0
        self.reached = threading.Event()
        self.thread = threading.Thread(target=self.spinner.run, daemon=True)

    def count(self, ticks: int) -> None:
        """Let so many timer callbacks pass."""
        self.reached.clear()
        self.wanted = self.ticks + ticks
        assert self.reached.wait(PATIENCE_S)

    def tick(self) -> None:
        self.ticks += 1
        if self.ticks == self.wanted:
            self.reached.set()

    def ends(self) -> bool:
        self.thread.join(PATIENCE_S)
        return not self.thread.is_alive()


@pytest.fixture
def bench(_ros: None) -> Iterator[Bench]:
    made = Bench()
    yield made
    if made.thread.is_alive():
        made.spinner.stop()
        assert made.ends()
    made.executor.shutdown()
    made.node.destroy_node()


def functions() -> int:
    gc.collect()
    return sum(isinstance(thing, types.FunctionType) for thing in gc.get_objects())


def test_nothing_is_kept_of_what_was_handled(bench: Bench) -> None:
    bench.node.create_timer(0.0002, bench.tick)
    bench.thread.start()
    bench.count(100)
    before = functions()
    bench.count(500)
    assert functions() - before < 100
    bench.spinner.stop()
    assert bench.ends()


def test_told_while_there_is_nothing_to_do(bench: Bench) -> None:
    bench.thread.start()
    bench.thread.join(0.2)
    assert bench.thread.is_alive()
    bench.spinner.stop()
    assert bench.ends()


def test_told_before_and_once_more_after_the_end(bench: Bench) -> None:
    bench.spinner.stop()
    bench.spinner.run()
    bench.executor.shutdown()
    bench.spinner.stop()


def test_a_callback_that_raises_ends_it_and_is_told(bench: Bench) -> None:
    def fail() -> Any:
        raise LookupError("of the callback")

    bench.node.create_timer(0.001, fail)
    with pytest.raises(LookupError, match="of the callback"):
        bench.spinner.run()
    bench.spinner.stop()
