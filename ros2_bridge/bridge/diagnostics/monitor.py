"""The monitor thread: looks ten times a second who listens and how things are, and publishes /diagnostics.

A thread of its own, so that neither a service that waits for the server nor the stream holds it up. It
publishes every second, and at once when a level changes. What happened for a moment only is kept until a
regular report, a second after the one before, has carried it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from bota_ethercat.health.verdict import Level, Limits
from bridge.diagnostics.health import Status, judge, text_of
from bridge.diagnostics.observer import CompensationState, Observer, Snapshot
from bridge.publishing.messages import Outputs, create_publisher
from bridge.stream.reader import Reader

TICK_S: Final = 0.1
REPORT_S: Final = 1.0
_LEVELS: Final = {
    Level.GOOD: DiagnosticStatus.OK,
    Level.LOOK: DiagnosticStatus.WARN,
    Level.TROUBLE: DiagnosticStatus.ERROR,
    Level.NOT_POSSIBLE: DiagnosticStatus.STALE,
}


class Monitor:
    """Runs from `start` to `stop`. `on_failure` hears of an error that should not be."""

    def __init__(
        self,
        node: Node,
        limits: Limits,
        reader: Reader,
        compensation: Callable[[], CompensationState],
        outputs: Outputs,
        on_failure: Callable[[str], object],
    ) -> None:
        self._observer, self._clock = Observer(reader, compensation), reader.link.clock
        self.limits = limits
        """May be replaced at any time."""
        self._outputs, self._on_failure = outputs, on_failure
        self._prefix = node.get_fully_qualified_name().lstrip("/") + ": "
        self._publisher = create_publisher(node, DiagnosticArray, "/diagnostics")
        self._published_s = self._clock.monotonic()
        self._levels: list[Level] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="monitor", daemon=True)

    def start(self) -> None:
        """Start looking."""
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Stop and wait for the thread; False if it does not end in time."""
        self._stopping.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._clock.wait(self._stopping, TICK_S):
                self.tick()
        except Exception as error:  # noqa: BLE001 - without diagnostics the node would seem dead
            if not self._stopping.is_set():
                self._on_failure(f"the monitor failed: {type(error).__name__}: {error}")

    def tick(self) -> None:
        """Look once, and publish if it is time or a level has changed."""
        self._outputs.refresh()
        now_s = self._clock.monotonic()
        regular = now_s - self._published_s >= REPORT_S
        if regular:
            self._observer.measure(now_s)
        snapshot = self._observer.look(now_s)
        statuses = judge(snapshot, self.limits)
        levels = [status.level for status in statuses]
        if regular or levels != self._levels:
            self._levels, self._published_s = levels, now_s
            self._publish(statuses, snapshot)
        if regular:
            self._observer.begin_interval(snapshot, now_s)

    def _publish(self, statuses: Sequence[Status], snapshot: Snapshot) -> None:
        info = snapshot.info
        message = DiagnosticArray()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self._clock.time_ns(), 1_000_000_000)
        message.status = [
            DiagnosticStatus(
                name=self._prefix + status.name,
                level=_LEVELS[status.level],
                message=status.message,
                hardware_id=f"{info.name} {info.serial}" if info else "",
                values=[KeyValue(key=key, value=text_of(value)) for key, value in status.values.items()],
            )
            for status in statuses
        ]
        self._publisher.publish(message)
