"""The monitor thread: looks ten times a second who listens and how things are, and publishes /diagnostics.

A thread of its own, so that neither a service that waits for the server nor the stream holds it up. It
publishes every second, and at once when a level changes. What happened for a moment only is kept until a
regular report, a second after the one before, has carried it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from bota_ethercat.errors import ConnectionFailedError
from bota_ethercat.health.observer import p99
from bota_ethercat.health.verdict import Level, Limits
from bota_ethercat.text.json_text import JsonObject
from bota_ethercat.text.untrusted import printable
from bridge.diagnostics.health import OF_SERVER, CompensationState, Counts, Snapshot, Status, judge
from bridge.process import Worker
from bridge.publishing.messages import create_publisher
from bridge.stream.reader import Flags, Outputs, Reader

TICK_S: Final = 0.1
_REPORT_S: Final = 1.0
_SHORTEST_RATE_S: Final = 0.8  # a rate measured over less time than this says little
_LEVELS: Final = {
    Level.GOOD: DiagnosticStatus.OK,
    Level.LOOK: DiagnosticStatus.WARN,
    Level.TROUBLE: DiagnosticStatus.ERROR,
    Level.NOT_POSSIBLE: DiagnosticStatus.STALE,
}


class Monitor:
    """Its `thread` runs until `stop`. `on_failure` hears of an error that should not be."""

    def __init__(
        self,
        node: Node,
        limits: Limits,
        reader: Reader,
        compensation: Callable[[], CompensationState],
        outputs: Outputs,
        on_failure: Callable[[str], object],
    ) -> None:
        self.limits = limits  # may be replaced at any time
        self._reader, self._link, self._clock = reader, reader.link, reader.link.clock
        self._compensation, self._outputs = compensation, outputs
        self._prefix = node.get_fully_qualified_name().lstrip("/") + ": "
        self._publisher = create_publisher(node, DiagnosticArray, "/diagnostics")
        self._levels: list[Level] = []
        self._status: Mapping[str, Any] = {}  # the server's newest, of this connection
        self._connects, self._asked_s, self._waiting = 0, 0.0, dict[str, Future[JsonObject]]()
        self._flags = Flags()
        self._age_us: tuple[float, float] | None = None
        self._rate_hz: float | None = None
        self._published_s = now_s = self._clock.monotonic()
        # The last number of fresh samples, when it changed, and the link's epoch.
        self._fresh, self._fresh_s, self._epoch = 0, now_s, -1
        # Where the rate is measured from: samples, time here, and the newest one's stamp.
        self._rate_fresh, self._rate_s, self._rate_ns = 0, now_s, -1
        # As of the last regular report, and whether the server's counts are in it.
        self._then, self._same_server = Counts(), False
        self._stopping = threading.Event()
        self.thread = Worker("monitor", self._run, on_failure)

    def stop(self) -> bool:
        """Stop and wait for the thread; False if it does not end in time."""
        self._stopping.set()
        return self.thread.has_ended()

    def _run(self) -> None:
        while not self._clock.wait(self._stopping, TICK_S):
            self.tick()

    def tick(self) -> None:
        """Look once, and publish if it is time or a level has changed."""
        self._outputs.refresh()
        now_s = self._clock.monotonic()
        regular = now_s - self._published_s >= _REPORT_S
        if regular:
            self._measure(now_s)
        snapshot = self._look(now_s)
        statuses = judge(snapshot, self.limits)
        levels = [status.level for status in statuses]
        if regular or levels != self._levels:
            self._levels, self._published_s = levels, now_s
            self._publish(statuses, snapshot)
        if regular:
            self._begin_interval(snapshot, now_s)

    def _measure(self, now_s: float) -> None:
        """Work out rate and ages of the interval that ends."""
        ages, link = self._reader.watch.take_ages(), self._link
        self._age_us = None
        if ages and link.is_connected and link.client.session.same_machine:
            self._age_us = ages[len(ages) // 2] / 1e3, (p99(ages) or 0) / 1e3
        if link.epoch != self._epoch:
            return
        fresh, elapsed_s = self._reader.counts.new, now_s - self._rate_s
        newest_ns = self._reader.accounting.new_ns
        # By the stamps, as a delay here is none of the sensor's; by the clock if it has become silent.
        span_s = (newest_ns - self._rate_ns) * 1e-9 if self._rate_ns >= 0 else 0.0
        span_s = span_s if span_s >= _SHORTEST_RATE_S else elapsed_s
        self._rate_hz = (fresh - self._rate_fresh) / span_s if elapsed_s >= _SHORTEST_RATE_S else None
        self._rate_fresh, self._rate_s, self._rate_ns = fresh, now_s, newest_ns

    def _look(self, now_s: float) -> Snapshot:
        """How things are now."""
        link, reader = self._link, self._reader
        self._collect()
        status, compensation, seen = self._status, self._compensation(), reader.counts
        counts = Counts(
            link.connects, seen.new, seen.missing, seen.stale, seen.limited, seen.repeated, seen.invalid,
            reader.not_finite, reader.watch.saturated, compensation.withheld,
        ).with_server(status, link.sensor)  # fmt: skip
        if link.epoch != self._epoch:
            self._epoch, self._rate_hz = link.epoch, None
            self._rate_fresh, self._rate_s = counts.samples, now_s
            self._rate_ns = reader.accounting.new_ns
        if counts.samples != self._fresh:
            self._fresh, self._fresh_s = counts.samples, now_s
        self._flags = self._flags.merge(reader.watch.take_flags())
        sample = reader.watch.sample
        return Snapshot(
            sensor=link.sensor,
            address=link.address,
            connected=link.is_connected,
            problem=link.problem,
            is_reachable=link.is_reachable,
            connection_s=now_s - link.since_s,
            info=link.info,
            lost=link.lost,
            silent_s=max(now_s - max(self._fresh_s, link.since_s), 0.0),
            rate_hz=self._rate_hz,
            expected_hz=link.rate_hz,
            age_us=self._age_us,
            counts=counts,
            new=counts.since(self._then, same_server=self._same_server and bool(status)),
            flags=self._flags,
            temperature=None if sample is None else sample.temperature,
            server=status,
            answer_s=now_s - self._asked_s if self._waiting else 0.0,
            settings=link.settings,
            compensation=compensation,
        )

    def _begin_interval(self, reported: Snapshot, now_s: float) -> None:
        """`reported` was a regular report: what is new counts from there on. Asks the server again."""
        self._flags, link = Flags(), self._link
        counts = reported.counts
        if not reported.server:  # what it had counted before is still known, unless it is another one then
            of_server = zip(OF_SERVER, self._then[-len(OF_SERVER) :], strict=True)
            counts = counts._replace(**dict(of_server))
        self._then = counts
        self._same_server = bool(reported.server) or (self._same_server and reported.connected)
        if link.is_connected and not self._waiting:  # unless an answer is still owed
            self._asked_s = now_s
            try:
                for action in ("status", "describe"):
                    self._waiting[action] = link.client.request(action)
            except ConnectionFailedError:
                self._waiting = {}  # the reader will notice

    def _collect(self) -> None:
        """Take what the server has answered, without waiting; the link gets the description."""
        link = self._link
        if not link.is_connected or link.connects != self._connects:
            self._connects, self._status, self._waiting = link.connects, {}, {}
        for action in [action for action, reply in self._waiting.items() if reply.done()]:
            reply = self._waiting.pop(action)
            if reply.exception() is None and (content := reply.result()).get("ok") is True:
                if action == "status":
                    self._status = content
                else:
                    link.described(content)

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


def text_of(value: object) -> str:
    """A value as a KeyValue carries it."""
    return str(value).lower() if isinstance(value, bool) else printable(value)
