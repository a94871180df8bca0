# SPDX-License-Identifier: Apache-2.0
"""Runs an executor until it is told to stop, from any thread.

Not with rclpy's `spin_until_future_complete`: that keeps a callback for every message it has handled. Nor
with `spin` and `shutdown`: that takes the executor's guard condition from under a thread that waits for it.
"""

from __future__ import annotations

import threading

from rclpy.executors import Executor, ExternalShutdownException


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
