"""What the demo measures: which of the server's samples came as ROS messages, by their stamps, and how old.

The demo has a TCP connection of its own to the server. No sockets, no ROS.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.accounting import FrameKind, StreamAccounting
from bota_ethercat.framing import DataMessage

FULL_RATE: Final = 0.95  # fewer messages than this part of the samples: something could not keep up
_LEAST_RATE: Final = 0.6  # fewer than this part, and something is wrong


class Summary(NamedTuple):
    """The figures of a whole run."""

    messages: int
    rate_hz: float
    lost: int  # samples that came from the server, but not on the topic
    lost_before: int  # samples that were lost, or withheld from the client, before that
    repeated: int
    unknown: int  # messages with the stamp of no sample
    age_ms: Sequence[float]  # of messages at the subscriber: median, 99th percentile
    all_finite: bool


class Measurement:
    """Takes samples and messages as they come; not locked, so call it from one thread at a time."""

    def __init__(self, rate_hz: float) -> None:
        """`rate_hz` is the sensor's: a gap is as long as its rate has it."""
        self.rate_hz = rate_hz
        self.begin()

    def begin(self) -> None:
        """Count from here: what came while things were starting is none of the figures."""
        self._stream = StreamAccounting()
        self._stream.rate_hz = self.rate_hz
        self.latest: DataMessage | None = None
        self._not_finite = 0
        # CLOCK_REALTIME, ns: when each sample was made; the stamp of each message, and when it came.
        self._made, self._stamps, self._arrived = array("q"), array("q"), array("q")

    @property
    def messages(self) -> int:
        """Of the topic."""
        return len(self._stamps)

    def add_frame(self, frame: DataMessage) -> None:
        """A frame came from the server."""
        if self._stream.count(frame.sequence, frame.monotonic_ns, frame.flags) is FrameKind.NEW:
            self.latest = frame
            self._made.append(frame.stamp_ns)

    def add_message(self, stamp_ns: int, values: Sequence[float], now_ns: int) -> None:
        """A message came on the ROS topic."""
        self._not_finite += not all(map(math.isfinite, values))
        self._stamps.append(stamp_ns)
        self._arrived.append(now_ns)

    def summary(self, newest: int = 0) -> Summary:
        """The figures so far, or those of as many of the `newest` messages."""
        made, stamps, arrived = (
            np.array(each, np.int64) for each in (self._made, self._stamps, self._arrived)
        )
        stamps, arrived = stamps[-newest:], arrived[-newest:]
        # Where both streams were heard: the latest of one may not have come as the other yet.
        both = (stamps >= made.min(initial=1 << 62)) & (stamps <= made.max(initial=0))
        here = (made >= stamps.min(initial=1 << 62)) & (made <= stamps.max(initial=0))
        unique, missing = np.unique(stamps[both]), self._stream.counts.missing
        points = np.percentile((arrived - stamps) if stamps.size else [0], (50, 99), method="higher")
        seconds = np.ptp(arrived) * 1e-9 if stamps.size else 0.0
        return Summary(
            messages=len(stamps),
            rate_hz=(len(stamps) - 1) / seconds if seconds else 0.0,
            lost=len(np.setdiff1d(made[here], unique)),
            lost_before=missing,
            repeated=len(stamps[both]) - len(unique),
            # Where samples were withheld from the server's client, a message may be one of them.
            unknown=max(len(np.setdiff1d(unique, made)) - missing, 0),
            age_ms=[float(point) / 1e6 for point in points],
            all_finite=self._not_finite == 0,
        )


def verdict(summary: Summary, nominal_hz: float) -> str | None:
    """What is wrong, in one sentence; None if all is well."""
    if not summary.messages:
        return "nothing arrived on the ROS topic"
    if not summary.all_finite:
        return "a message held a number that is not finite"
    if summary.unknown:
        return "a message on the ROS topic is no sample of the sensor"
    if summary.repeated:
        return f"{summary.repeated} messages came twice"
    if not _LEAST_RATE * nominal_hz <= summary.rate_hz <= 1.05 * nominal_hz:
        return f"{summary.rate_hz:.1f} messages/s arrived and the sensor makes {nominal_hz:g} samples/s"
    return None
