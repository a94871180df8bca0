"""What the demo measures: every ROS message is looked up among the server's samples.

The demo has a TCP connection of its own to the server. A message of the array topic has no time stamp, so its
age and whether it was decoded right follow from the sample with exactly the same twelve values. No sockets,
no ROS.
"""

from __future__ import annotations

import functools
import math
from array import array
from collections import OrderedDict, deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from bota_ethercat.accounting import FrameKind, StreamAccounting
from bota_ethercat.framing import DataMessage
from bota_ethercat.pdo import Sample, SampleDecoder
from scripts.benchmarks.statistics import Ints, in_stops

_REMEMBERED: Final = 8192  # samples: some seconds' worth
FULL_RATE: Final = 0.95  # fewer messages than this part of the samples: something could not keep up
_LEAST_RATE: Final = 0.6  # fewer than this part, and something is wrong
NO_STOPS: Final[Ints] = np.empty((0, 2), dtype=np.int64)

_decoder = functools.cache(SampleDecoder)


class Summary(NamedTuple):
    """The figures of a whole run."""

    messages: int
    rate_hz: float
    lost: int  # samples that came from the server, but not on the topic
    lost_before: int  # samples that were lost, or withheld from the client, before that
    lost_in_stops: int  # of both: those made while the machine stopped
    stops: int
    longest_stop_ms: float
    repeated: int
    age_ms: Sequence[float]  # of messages at the subscriber: median, 99th percentile
    tcp_age_ms: Sequence[float]
    all_finite: bool
    all_decoded_right: bool


class Measurement:
    """Takes samples and messages as they come; not locked, so call it from one thread at a time."""

    def __init__(self, rate_hz: float = 0.0) -> None:
        """`rate_hz` is the sensor's: a gap is as long as its rate has it."""
        self.rate_hz = rate_hz
        self.latest: Sample | None = None
        self.age_ns = 0  # of the newest message on its arrival
        self._stream = StreamAccounting()
        self._made_ns = array("q")  # of each sample that came from the server
        self._known: OrderedDict[tuple[float, ...], int] = OrderedDict()  # its index there
        self._waiting: deque[tuple[tuple[float, ...], int]] = deque()  # messages whose sample has not come
        self._indices = array("q")  # of the samples that came as messages
        self._last_ns = 0
        self.begin()

    def begin(self) -> None:
        """Count from here: what came while things were starting is none of the figures."""
        self._missing_before = self._stream.counts.missing
        # Messages, those of a sample that an earlier one had, those that equal no sample.
        self.messages = self.repeated = self._not_finite = self._unknown = 0
        self._missing_ns: list[float] = []  # when the missing samples were made
        self._ages_ns, self._tcp_ages_ns = array("q"), array("q")
        self._indices = self._indices[-1:]
        self._first_ns = self._last_ns

    def take_frame(self, frame: DataMessage, now_ns: int) -> None:
        """A frame came from the server."""
        before, self._stream.rate_hz = self._stream.counts.missing, self.rate_hz
        kind = self._stream.take(frame.sequence, frame.monotonic_ns, frame.flags)
        if missing := self._stream.counts.missing - before:
            self._missing_ns += np.linspace(self._passed_ns, frame.monotonic_ns, missing + 2)[1:-1].tolist()
        if kind is not FrameKind.NEW:
            return
        self.latest = _decoder(len(frame.process_data)).decode(frame.process_data)
        values = tuple(self.latest.array)
        self._known[values] = len(self._made_ns)
        self._known.move_to_end(values)
        if len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)
        self._made_ns.append(frame.monotonic_ns)
        self._tcp_ages_ns.append(now_ns - frame.monotonic_ns)
        self._look_up()

    @property
    def _passed_ns(self) -> int:
        """Samples up to this instant have come from the server, if they were not withheld."""
        return self._made_ns[-1] if self._made_ns else 0

    def take_message(self, values: Sequence[float], now_ns: int) -> None:
        """A message came on the ROS topic."""
        self._not_finite += not all(map(math.isfinite, values))
        self._waiting.append((tuple(values), now_ns))
        self._look_up()

    def _look_up(self) -> None:
        while self._waiting:
            values, arrived_ns = self._waiting[0]
            if (index := self._known.get(values)) is not None:
                if not self._indices:
                    self._first_ns = arrived_ns
                elif index <= self._indices[-1]:
                    self.repeated += 1
                self.messages += 1
                self._indices.append(index)
                self._last_ns, self.age_ns = arrived_ns, arrived_ns - self._made_ns[index]
                self._ages_ns.append(self.age_ns)
            elif self._passed_ns <= arrived_ns:
                return  # its sample may still come
            elif self._indices:  # before the first match the two streams need not overlap
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
        return self._stream.counts.missing - self._missing_before

    @property
    def lost(self) -> int:
        """Samples, from the first message's to the last's, that came from the server but not on the topic."""
        found = self._indices
        return found[-1] - found[0] + 1 - len(set(found)) if found else 0

    def summary(self, stops: Ints = NO_STOPS) -> Summary:
        """The figures so far; `stops` of the machine, (n, 2), begin and end in CLOCK_MONOTONIC ns."""
        found, seconds = self._indices, (self._last_ns - self._first_ns) / 1e9
        lost = set(range(found[0], found[-1])).difference(found) if found else ()
        missing = np.array([*self._missing_ns, *(self._made_ns[n] for n in lost)])
        return Summary(
            messages=self.messages,
            rate_hz=(len(found) - 1) / seconds if seconds > 0 else 0.0,
            lost=self.lost,
            lost_before=self.lost_before,
            lost_in_stops=in_stops(missing, 1e9 / self.rate_hz, stops) if self.rate_hz else 0,
            stops=len(stops),
            longest_stop_ms=float(np.max(np.diff(stops), initial=0)) / 1e6,
            repeated=self.repeated,
            age_ms=_median_and_p99_ms(self._ages_ns),
            tcp_age_ms=_median_and_p99_ms(self._tcp_ages_ns),
            all_finite=self._not_finite == 0,
            # Where samples were withheld from the server's client, a message may be one of them.
            all_decoded_right=self._unknown <= self._stream.counts.missing,
        )


def _median_and_p99_ms(ages_ns: array[int]) -> list[float]:
    points: list[float] = (np.percentile(ages_ns or [0], (50, 99), method="higher") / 1e6).tolist()
    return points


def explanation(summary: Summary) -> str | None:
    """Why samples are missing, in words; None if none are."""
    missing = summary.lost + summary.lost_before
    if not missing:
        return None
    if not summary.stops:
        return (
            f"{missing} samples are missing, although this machine never stopped: clients could not keep up."
        )
    times = f"{summary.stops} times" if summary.stops > 1 else "once"
    return (
        f"{missing} samples are missing, {summary.lost_in_stops} of them made while this machine itself "
        f"stopped, which it did {times}, for up to {summary.longest_stop_ms:.1f} ms: other programs or "
        "a hypervisor had its processors. 'A steadier cycle' in docs/operations.md helps."
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
