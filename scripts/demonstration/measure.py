"""What the demo measures: every ROS message is looked up among the server's samples.

The demo has a TCP connection of its own to the server. A message of the array topic has no time stamp, so its
age and whether it was decoded right follow from the sample with exactly the same twelve values. No sockets,
no ROS.
"""

from __future__ import annotations

import functools
import math
from array import array
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.accounting import FrameKind, StreamAccounting
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample, SampleDecoder

_REMEMBERED: Final = 8192  # samples: some seconds' worth
FULL_RATE: Final = 0.95  # fewer messages than this part of the samples: something could not keep up
_LEAST_RATE: Final = 0.6  # fewer than this part, and something is wrong

_decoder = functools.cache(SampleDecoder)


class Summary(NamedTuple):
    """The figures of a whole run."""

    messages: int
    rate_hz: float
    lost: int  # samples that came from the server, but not on the topic
    lost_before: int  # samples that were lost, or withheld from the client, before that
    repeated: int
    age_ms: Sequence[float]  # of messages at the subscriber: median, 99th percentile
    all_finite: bool
    all_decoded_right: bool


class Measurement:
    """Takes samples and messages as they come; not locked, so call it from one thread at a time."""

    def __init__(self, rate_hz: float) -> None:
        """`rate_hz` is the sensor's: a gap is as long as its rate has it."""
        self.rate_hz = rate_hz
        self.latest: Sample | None = None
        self.begin()

    def begin(self) -> None:
        """Count from here: what came while things were starting is none of the figures."""
        self._stream = StreamAccounting()
        self._stream.rate_hz = self.rate_hz
        # Messages, those of a sample that an earlier one had, those that equal no sample.
        self.messages = self.repeated = self._not_finite = self._unknown = 0
        self.age_ns = 0  # of the newest message on its arrival
        self._made_ns = array("q")  # of each sample that came from the server: when it was made
        self._known: dict[tuple[float, ...], int] = {}  # by its values: its index there
        self._waiting: deque[tuple[tuple[float, ...], int]] = deque()  # messages whose sample has not come
        self._indices, self._arrived_ns = array("q"), array("q")  # of the samples that came as messages

    def take_frame(self, frame: DataMessage) -> None:
        """A frame came from the server."""
        if self._stream.count(frame.sequence, frame.monotonic_ns, frame.flags) is not FrameKind.NEW:
            return
        self.latest = _decoder(len(frame.process_data)).decode(frame.process_data)
        values = tuple(self.latest.array)
        self._known.pop(values, None)
        self._known[values] = len(self._made_ns)
        if len(self._known) > _REMEMBERED:
            del self._known[next(iter(self._known))]
        self._made_ns.append(frame.monotonic_ns)
        self._look_up()

    def take_message(self, values: Sequence[float], now_ns: int) -> None:
        """A message came on the ROS topic."""
        self._not_finite += not all(map(math.isfinite, values))
        self._waiting.append((tuple(values), now_ns))
        self._look_up()

    def _look_up(self) -> None:
        while self._waiting:
            values, arrived_ns = self._waiting[0]
            if (index := self._known.get(values)) is not None:
                self.repeated += self.began and index <= self._indices[-1]
                self.messages += 1
                self._indices.append(index)
                self._arrived_ns.append(arrived_ns)
                self.age_ns = arrived_ns - self._made_ns[index]
            elif not self._made_ns or self._made_ns[-1] <= arrived_ns:
                return  # its sample may still come
            elif self.began:  # before the first match the two streams need not overlap
                self.messages += 1
                self._unknown += 1
            self._waiting.popleft()

    @property
    def began(self) -> bool:
        """Whether messages come that are the server's samples."""
        return bool(self._indices)

    @property
    def lost_before(self) -> int:
        """Samples since `begin` that were lost or withheld before they could become a message."""
        return self._stream.counts.missing

    @property
    def lost(self) -> int:
        """Samples, from the first message's to the last's, that came from the server but not on the topic."""
        found = self._indices
        return found[-1] - found[0] + 1 - len(found) + self.repeated if found else 0

    def summary(self) -> Summary:
        """The figures so far."""
        index, made, arrived = (
            np.array(a, np.int64) for a in (self._indices, self._made_ns, self._arrived_ns)
        )
        ages = arrived - made[index]
        points = np.percentile(ages if ages.size else [0], (50, 99), method="higher")
        seconds = np.ptp(arrived) / 1e9 if self.began else 0.0
        return Summary(
            messages=self.messages,
            rate_hz=(len(index) - 1) / seconds if seconds else 0.0,
            lost=self.lost,
            lost_before=self.lost_before,
            repeated=self.repeated,
            age_ms=[float(point) / 1e6 for point in points],
            all_finite=self._not_finite == 0,
            # Where samples were withheld from the server's client, a message may be one of them.
            all_decoded_right=self._unknown <= self._stream.counts.missing,
        )


def verdict(summary: Summary, nominal_hz: float) -> str | None:
    """What is wrong, in one sentence; None if all is well."""
    if not summary.messages:
        return "nothing arrived on the ROS topic"
    if not summary.all_finite:
        return "a message held a number that is not finite"
    if not summary.all_decoded_right:
        return "a message on the ROS topic is no sample of the sensor"
    if summary.repeated:
        return f"{summary.repeated} messages came twice"
    if not _LEAST_RATE * nominal_hz <= summary.rate_hz <= 1.05 * nominal_hz:
        return f"{summary.rate_hz:.1f} messages/s arrived and the sensor makes {nominal_hz:g} samples/s"
    return None
