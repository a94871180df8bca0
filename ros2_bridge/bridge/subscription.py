# SPDX-License-Identifier: Apache-2.0
"""What a subscriber of one of the node's topics has lost: no ROS of its own, for use beside a callback.

    subscription = Subscription("/wrench")
    node.create_subscription(DiagnosticArray, "/bridge/published", subscription.published, 10)

    def on_wrench(message):
        subscription.receive(message.header.stamp, time.time_ns())

    print(subscription.received, subscription.lost, subscription.missing, subscription.age_ns)

The node's report says how many messages with a stamp up to some time it has published. It is compared once a
later message is here: then no earlier one will come. clients/cpp has the same in C++.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

_MOST: Final = 65536  # messages without a report


class Subscription:
    """For one thread.

    Attributes:
        received: messages.
        lost: messages that the node has published, but that did not come: between the first and the last
            report that are compared.
        missing: samples that did not come for whatever reason, by the grid of the stamps: also those lost
            on the bus, skipped, or left out by `publishing_frequency`. From the first report on.
        age_ns: of the newest message, by the time that `receive` was given.
        rate_hz: of the sensor; 0 as long as there was no report, so that `lost` and `missing` are unknown.
    """

    received = lost = missing = age_ns = 0
    rate_hz = 0.0

    def __init__(self, topic: str) -> None:
        """`topic`: the resolved name."""
        self._topic = topic
        self._begin()

    def _begin(self) -> None:
        """Nothing before the next message counts: it is the first, or the node or a clock has been reset."""
        self._stamps: deque[int] = deque()  # received since the last report that was compared
        self._reports: deque[tuple[int, int]] = deque()  # stamp and count, to be compared
        self._newest = (-1, -1)
        self._count: int | None = None  # of the last report that was compared

    def receive(self, stamp: Any, now_ns: int) -> None:
        """Take a message by its stamp, `builtin_interfaces/Time`; `now_ns` is the time since 1970."""
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        if self._stamps and (stamp_ns <= self._stamps[-1] or len(self._stamps) == _MOST):
            self._begin()
        elif self._stamps:
            self.missing += max(0, round((stamp_ns - self._stamps[-1]) * self.rate_hz / 1e9) - 1)
        self._stamps.append(stamp_ns)
        self.received += 1
        self.age_ns = now_ns - stamp_ns
        while self._reports and self._reports[0][0] < stamp_ns:
            self._compare()

    def published(self, report: Any) -> None:
        """Take a report, `diagnostic_msgs/DiagnosticArray`."""
        for status in report.status:
            if status.name == self._topic and self._stamps:
                values = {value.key: value.value for value in status.values}
                stamp_ns, count = newest = int(values["stamp_ns"]), int(values["count"])
                self.rate_hz = float(values["rate_hz"])
                if stamp_ns < self._newest[0] or count < self._newest[1]:
                    self._begin()
                elif stamp_ns >= self._stamps[0] or self._count is not None:
                    self._newest = newest
                    self._reports.append(newest)
                    if stamp_ns < self._stamps[-1]:
                        self._compare()

    def end(self) -> None:
        """No more messages come: compare what is left."""
        while self._reports:
            self._compare()

    def _compare(self) -> None:
        (stamp_ns, count), received = self._reports.popleft(), 0
        while self._stamps and self._stamps[0] <= stamp_ns:
            self._stamps.popleft()
            received += 1
        if self._count is not None:
            self.lost += count - self._count - received
        self._count = count
