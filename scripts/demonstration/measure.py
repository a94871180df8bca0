"""What the demo measures: every ROS message is looked up among the server's samples.

The demo has a TCP connection of its own to the server. A message of the array topic has no time stamp, so its
age and whether it was decoded right follow from the sample with exactly the same twelve values. No sockets,
no ROS.
"""

from __future__ import annotations

import math
from array import array
from collections import OrderedDict, deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from protocol.accounting import FrameKind, StreamAccounting
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import Sample, SampleDecoder
from scripts.benchmarks.statistics import COVERED, Ints, covered

_REMEMBERED: Final = 8192  # samples: some seconds' worth
_AROUND_A_GAP_NS: Final = 1_000_000_000  # a message may be of a sample withheld so long before
FULL_RATE: Final = 0.95  # fewer messages than this part of the samples: something could not keep up
_LEAST_RATE: Final = 0.6  # fewer than this part, and something is wrong
NO_STOPS: Final[Ints] = np.empty((0, 2), dtype=np.int64)

Values = tuple[float, ...]


class Summary(NamedTuple):
    """The figures of a whole run."""

    messages: int
    rate_hz: float
    lost: int
    """Samples that came from the server, but not on the topic."""
    lost_before: int
    """Samples that were lost, or withheld from the client, before that."""
    lost_in_stops: int
    """Of both: those made while the machine stopped."""
    stops: int
    longest_stop_ms: float
    repeated: int
    age_ms: tuple[float, float]
    """Of messages at the subscriber: median, 99th percentile."""
    tcp_age_ms: tuple[float, float]
    all_finite: bool
    all_decoded_right: bool


class Measurement:
    """Takes samples and messages as they come; not locked, so call it from one thread at a time."""

    def __init__(self, rate_hz: float = 0.0) -> None:
        """`rate_hz` is the sensor's: a gap is as long as its rate has it."""
        self.rate_hz = rate_hz
        self.latest: Sample | None = None
        self.age_ns = 0
        """Age of the newest message on its arrival."""
        self._stream = StreamAccounting()
        self._made_ns = array("q")  # of each sample that came from the server
        self._known: OrderedDict[Values, int] = OrderedDict()  # its index there
        self._waiting: deque[tuple[Values, int]] = deque()  # messages whose sample has not come
        self._decoders: dict[int, SampleDecoder] = {}
        self._gap_ns = -(10**18)  # when the latest gap in what comes from the server ended
        self._indices = array("q")  # of the samples that came as messages
        self._last_ns = 0
        self.begin()

    def begin(self) -> None:
        """Count from here: what came while things were starting is none of the figures."""
        self._missing_before = self._stream.counts.missing
        self.messages = self.repeated = self._not_finite = self._unknown = 0
        """Messages; those of a sample that an earlier one had; ... that equal no sample."""
        self._missing_ns: list[float] = []  # when the missing samples were made
        self._ages_ns, self._tcp_ages_ns = array("q"), array("q")
        self._indices = self._indices[-1:]
        self._first_ns = self._last_ns

    def take_frame(self, frame: DataMessage, now_ns: int) -> None:
        """A frame came from the server."""
        if frame.flags & DataFlag.GAP:
            self._gap_ns = frame.monotonic_ns
        before, self._stream.rate_hz = self._stream.counts.missing, self.rate_hz
        kind = self._stream.take(frame.sequence, frame.monotonic_ns, frame.flags)
        if missing := self._stream.counts.missing - before:
            between = np.linspace(self._passed_ns, frame.monotonic_ns, missing + 2)[1:-1]
            self._missing_ns += between.tolist()
        if kind is not FrameKind.NEW:
            return
        size = len(frame.process_data)
        decoder = self._decoders.get(size) or self._decoders.setdefault(size, SampleDecoder(size))
        self.latest = decoder.decode(frame.process_data)
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
                # Where samples were withheld from the server's client, this one may be among them.
                self._unknown += arrived_ns > self._gap_ns + _AROUND_A_GAP_NS
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

    def _lost_in(self, stops: Ints) -> int:
        """How many of all that are missing were made in these stops of the machine."""
        missing = set(range(self._indices[0], self._indices[-1])) if self._indices else set()
        made = [*self._missing_ns, *(self._made_ns[n] for n in missing.difference(self._indices))]
        if not made or not self.rate_hz:
            return 0
        return int(np.count_nonzero(covered(np.array(made), 1e9 / self.rate_hz, stops) >= COVERED))

    def summary(self, stops: Ints = NO_STOPS) -> Summary:
        """The figures so far; `stops` of the machine, (n, 2), begin and end in CLOCK_MONOTONIC ns."""
        seconds = (self._last_ns - self._first_ns) / 1e9
        return Summary(
            messages=self.messages,
            rate_hz=(len(self._indices) - 1) / seconds if seconds > 0 else 0.0,
            lost=self.lost,
            lost_before=self.lost_before,
            lost_in_stops=self._lost_in(stops),
            stops=len(stops),
            longest_stop_ms=float((stops[:, 1] - stops[:, 0]).max()) / 1e6 if len(stops) else 0.0,
            repeated=self.repeated,
            age_ms=_median_and_p99_ms(self._ages_ns),
            tcp_age_ms=_median_and_p99_ms(self._tcp_ages_ns),
            all_finite=self._not_finite == 0,
            all_decoded_right=self._unknown == 0,
        )


def _median_and_p99_ms(ages_ns: array[int]) -> tuple[float, float]:
    if not ages_ns:
        return 0.0, 0.0
    median, p99 = np.percentile(ages_ns, (50, 99), method="higher")
    return median / 1e6, p99 / 1e6


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
