"""What the demo measures: which of the server's samples came as ROS messages, by their stamps, and how old.

The demo has a TCP connection of its own to the server. Time and memory do not grow with the run. No sockets,
no ROS.
"""

from __future__ import annotations

import math
import threading
from array import array
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

from bota_ethercat.accounting import FrameKind, StreamAccounting
from bota_ethercat.distribution import Distribution
from bota_ethercat.framing import DataMessage

FULL_RATE: Final = 0.95  # fewer messages than this part of the samples: something could not keep up
_LEAST_RATE: Final = 0.6  # fewer than this part, and something is wrong
_PAUSE_NS: Final = 10**9  # without a message for longer: this computer was suspended, say
_MOST_WAITING: Final = 1 << 14  # samples or messages that may wait for the other
_RECENT: Final = 1024  # messages of which one is known that comes again


class Figures(NamedTuple):
    """Of a whole run, or since the last `take_newest`."""

    messages: int
    rate_hz: float  # but for pauses
    lost: int  # in the whole run: samples that came from the server, but not on the topic
    lost_before: int  # samples that were lost, or withheld from the client, before that
    repeated: int
    unknown: int  # messages with the stamp of no sample
    age_ms: Sequence[float]  # of messages at the subscriber: median, 99th percentile
    all_finite: bool
    paused_s: float  # without a message, more than a second each


class _Messages:
    """Messages in some time."""

    def __init__(self) -> None:
        self.count = self.intervals = self.span_ns = self.paused_ns = 0
        self.ages = Distribution()

    def take(self, age_ns: int, interval_ns: int) -> None:
        self.count += 1
        self.ages.count(array("f", [age_ns]))
        if 0 <= interval_ns <= _PAUSE_NS:
            self.intervals, self.span_ns = self.intervals + 1, self.span_ns + interval_ns
        else:
            self.paused_ns += max(interval_ns, 0)

    def add(self, other: _Messages) -> None:
        self.count, self.intervals = self.count + other.count, self.intervals + other.intervals
        self.span_ns, self.paused_ns = self.span_ns + other.span_ns, self.paused_ns + other.paused_ns
        self.ages.add(other.ages)


class Measurement:
    """Takes samples and messages as they come, from any threads, which wait for one another only briefly.

    Attributes:
        latest: the newest sample; whoever has shown it sets it to None.
    """

    def __init__(self, rate_hz: float) -> None:
        """`rate_hz` is the sensor's: a gap is as long as its rate has it."""
        self.rate_hz = rate_hz
        self._lock = threading.Lock()
        self.begin()

    def begin(self) -> None:
        """Count from here: what came while things were starting is none of the figures."""
        with self._lock:
            self._stream = StreamAccounting()
            self._stream.rate_hz = self.rate_hz
            self.latest: DataMessage | None = None
            self._not_finite = self._lost = self._unmatched = self._repeated = 0
            self._before, self._newest = _Messages(), _Messages()  # until the last `take_newest`, and since
            self._arrived_ns = -1
            self._compare_anew()

    def interrupted(self) -> None:
        """The connection to the server has ended: what it sends until there is another is not compared."""
        with self._lock:
            self._stream.begin()
            self._compare_anew()

    def _compare_anew(self) -> None:
        # Stamps (CLOCK_REALTIME, ns; 0: none yet) in their order: of samples that are no message yet, and of
        # messages that are no sample yet; the first and the newest of both.
        self._made, self._heard = deque[int](), deque[int]()
        self._first_made = self._newest_made = self._first_heard = self._newest_heard = 0
        self._recent = deque[int](maxlen=_RECENT)

    @property
    def messages(self) -> int:
        """Of the topic."""
        return self._before.count + self._newest.count

    def add_frame(self, frame: DataMessage) -> None:
        """A frame came from the server."""
        with self._lock:
            if self._stream.count(frame.sequence, frame.monotonic_ns, frame.flags) is not FrameKind.NEW:
                return
            if frame.stamp_ns <= self._newest_made:
                self._compare_anew()  # the clock was set back
            self.latest, self._newest_made = frame, frame.stamp_ns
            self._first_made = self._first_made or frame.stamp_ns
            self._made.append(frame.stamp_ns)
            self._compare()

    def add_message(self, stamp_ns: int, values: Sequence[float], now_ns: int) -> None:
        """A message came on the ROS topic."""
        with self._lock:
            self._not_finite += not all(map(math.isfinite, values))
            self._newest.take(now_ns - stamp_ns, now_ns - self._arrived_ns if self._arrived_ns >= 0 else -1)
            self._arrived_ns = now_ns
            if stamp_ns <= self._newest_heard:
                if stamp_ns in self._recent:
                    self._repeated += 1
                    return
                self._compare_anew()
            self._newest_heard, self._first_heard = stamp_ns, self._first_heard or stamp_ns
            for kept in (self._recent, self._heard):
                kept.append(stamp_ns)
            self._compare()

    def _compare(self) -> None:
        """Settle what is older than the newest of the other, for both come in their order."""
        made, heard = self._made, self._heard
        while made or heard:
            here, there = made[0] if made else math.inf, heard[0] if heard else math.inf
            if here == there:
                made.popleft()
                heard.popleft()
            elif here < there:
                if here > self._newest_heard and len(made) <= _MOST_WAITING:
                    return
                made.popleft()
                self._lost += here > self._first_heard > 0
            else:
                if there > self._newest_made and len(heard) <= _MOST_WAITING:
                    return
                heard.popleft()
                self._unmatched += there > self._first_made > 0

    def take_newest(self) -> Figures:
        """The figures of the messages since the last call."""
        with self._lock:
            newest, self._newest = self._newest, _Messages()
            self._before.add(newest)
        return self._figures(newest)

    def summary(self) -> Figures:
        """The figures so far."""
        with self._lock:
            self._before.add(self._newest)
            self._newest = _Messages()
        return self._figures(self._before)

    def _figures(self, messages: _Messages) -> Figures:
        missing, ages_us = self._stream.counts.missing, messages.ages.summary_us()
        return Figures(
            messages=messages.count,
            rate_hz=messages.intervals * 1e9 / messages.span_ns if messages.span_ns else 0.0,
            lost=self._lost,
            lost_before=missing,
            repeated=self._repeated,
            # Where samples were withheld from the server's client, a message may be one of them.
            unknown=max(self._unmatched - missing, 0),
            age_ms=[ages_us["p50"] / 1e3, ages_us["p99"] / 1e3],
            all_finite=self._not_finite == 0,
            paused_s=messages.paused_ns * 1e-9,
        )


def verdict(summary: Figures, nominal_hz: float) -> str | None:
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
