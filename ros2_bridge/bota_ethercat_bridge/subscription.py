# SPDX-License-Identifier: Apache-2.0
"""What a subscriber of one of the node's topics has lost, for use beside its callback: no ROS of its own.

    subscription = Subscription("/wrench")
    node.create_subscription(DiagnosticArray, "/bridge/published", subscription.published, 10)
    # in the callback of /wrench: subscription.receive(message.header.stamp, time.time_ns())

A report says how many messages with a stamp up to some time the node has published. It is compared once a
later message is here: then no earlier one will come. bota_ethercat/subscription.hpp is the same in C++.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Iterator
from typing import Any, Final

from bota_ethercat.distribution import Distribution

_MOST: Final = 65536  # messages without a report
_CONTROL_MS: Final = 5.0  # older samples are no good to a control loop
_DEEP: Final = 100  # deep enough for a pause of the process, but not for a slow callback


class Subscription:
    """For one thread.

    Attributes:
        received: messages.
        lost: messages published, but not received, between the first and the last report that are compared.
        missing: samples not received for whatever reason, by the grid of the stamps, since the first report:
            also those lost on the bus, skipped, or left out by `publishing_frequency`.
        age_ns: of the newest message.
        rate_hz: of the sensor; 0 without a report.
    """

    received = lost = missing = age_ns = 0
    rate_hz = 0.0

    def __init__(self, topic: str) -> None:
        """`topic`: the resolved name."""
        self._topic = topic
        self._begin()

    def _begin(self) -> None:
        """Nothing before the next message counts: it is the first, or the node or a clock has been reset."""
        self._stamps = deque[int]()  # received since the last report that was compared
        self._reports = deque[tuple[int, int]]()  # stamp and count, to be compared
        self._newest, self._count = (-1, -1), -1  # the newest report; the count that was compared last

    def receive(self, stamp: Any, now_ns: int) -> None:
        """Take a message by its stamp, `builtin_interfaces/Time`; `now_ns` is the time since 1970."""
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        if self._stamps and (stamp_ns <= self._stamps[-1] or len(self._stamps) == _MOST):
            self._begin()
        elif self._stamps:
            self.missing += max(0, round((stamp_ns - self._stamps[-1]) * self.rate_hz / 1e9) - 1)
        self._stamps.append(stamp_ns)
        self.received, self.age_ns = self.received + 1, now_ns - stamp_ns
        self._compare(stamp_ns)

    def published(self, report: Any) -> None:
        """Take a report, `diagnostic_msgs/DiagnosticArray`."""
        for status in report.status if self._stamps else ():
            if status.name == self._topic:
                values = {value.key: value.value for value in status.values}
                stamp_ns, count = newest = int(values["stamp_ns"]), int(values["count"])
                self.rate_hz = float(values["rate_hz"])
                if stamp_ns < self._newest[0] or count < self._newest[1]:
                    self._begin()
                elif self._count >= 0 or stamp_ns >= self._stamps[0]:
                    self._newest = newest
                    self._reports.append(newest)
                    self._compare(self._stamps[-1])
                return

    def _compare(self, before_ns: int) -> None:
        while self._reports and self._reports[0][0] < before_ns:
            (stamp_ns, count), here = self._reports.popleft(), 0
            while self._stamps[0] <= stamp_ns:
                self._stamps.popleft()
                here += 1
            self.lost += count - self._count - here if self._count >= 0 else 0
            self._count = count


class Counted(Subscription):
    """With the ages of all messages."""

    def __init__(self, topic: str) -> None:
        super().__init__(topic)
        self.ages = Distribution()

    def receive(self, stamp: Any, now_ns: int) -> None:
        super().receive(stamp, now_ns)
        self.ages.count(array("f", [self.age_ns]))


def report(counted: Counted, depth: int, *, best_effort: bool) -> Iterator[str]:
    """What was measured, and what to change: a sentence each."""
    p50, p99, longest = (counted.ages.summary_us()[point] / 1e3 for point in ("p50", "p99", "max"))
    yield f"received {counted.received}, lost {counted.lost}, missing {counted.missing}"
    yield f"age p50 {p50:.1f} ms, p99 {p99:.1f} ms, longest {longest:.1f} ms"
    if not counted.rate_hz:
        yield "lost is not known: the publisher has no ~/published"
    elif counted.lost and best_effort:
        yield "lost by best effort: subscribe reliably"
    elif counted.lost and depth < _DEEP:
        yield f"the queue was too short for a pause of this process: raise the depth to {_DEEP}"
    elif counted.lost and p50 > 500 * depth / counted.rate_hz:
        yield "the queue is always full: use an executor for this topic alone, C++, or publishing_frequency"
    elif counted.lost:
        yield "long pauses: raise the depth, or give this process real-time priority"
    if p99 > _CONTROL_MS:
        yield "too old for a control loop: use real-time priority, or the ros2_control plugin"
    if counted.missing > counted.lost:
        yield f"{counted.missing - counted.lost} samples were not published: see the node's /diagnostics"
