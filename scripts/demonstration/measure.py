"""What the demo measures: every ROS message is looked up among the server's samples.

The demo has a TCP connection of its own to the server. A ROS message carries no time, so its age and
whether it was decoded right follow from the sample with exactly the same twelve values. No sockets, no ROS.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from protocol.accounting import FrameKind, StreamAccounting
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import Sample, SampleDecoder
from scripts.benchmarks.statistics import COVERED, Ints, covered

_REMEMBERED: Final = 8192
"""Samples that are remembered: some seconds' worth."""
_AROUND_A_GAP_NS: Final = 1_000_000_000
"""So long after samples were withheld a message may still be of one of them."""
FULL_RATE: Final = 0.95
"""Fewer messages than this part of the samples: something could not keep up."""
_LEAST_RATE: Final = 0.6
"""Fewer than this part, and something is wrong."""

NO_STOPS: Final[Ints] = np.empty((0, 2), dtype=np.int64)

Values = tuple[float, ...]


class Known(NamedTuple):
    """A sample that came from the server."""

    position: int
    monotonic_ns: int


class Summary(NamedTuple):
    """The figures of a whole run."""

    messages: int
    rate_hz: float
    lost: int
    lost_before: int
    lost_in_stops: int
    """Of both: those made while the machine stopped."""
    stops: int
    longest_stop_ms: float
    repeated: int
    age_p50_ms: float
    age_p99_ms: float
    tcp_age_p50_ms: float
    tcp_age_p99_ms: float
    all_finite: bool
    all_decoded_right: bool


@dataclass
class Measurement:
    """Takes samples and messages as they come; not locked, so call it from one thread at a time."""

    latest: Sample | None = None
    messages: int = 0
    repeated: int = 0
    """Messages with a sample that an earlier message had."""
    not_finite: int = 0
    unknown: int = 0
    """Messages that equal no sample."""
    age_ns: int = 0
    """Age of the newest message when it came."""
    ages_ns: list[int] = field(default_factory=list)
    tcp_ages_ns: list[int] = field(default_factory=list)
    rate_hz: float = 0.0
    """The sensor's, once it is known: a gap is as long as its rate has it."""
    _samples: int = 0
    _stream: StreamAccounting = field(default_factory=StreamAccounting)
    _missing_at_begin: int = 0
    _missing_ns: list[float] = field(default_factory=list)
    """When the missing samples were made."""
    _made_ns: array[int] = field(default_factory=lambda: array("q"))
    """When each that came from the server was made, by position from 1."""
    _known: dict[Values, Known] = field(default_factory=dict)
    _order: deque[Values] = field(default_factory=deque)
    _waiting: deque[tuple[Values, int]] = field(default_factory=deque)
    _decoders: dict[int, SampleDecoder] = field(default_factory=dict)
    _positions: list[int] = field(default_factory=list)
    _passed_ns: int = 0
    """Samples up to this instant have come from the server, if they were not withheld."""
    _gap_ns: int = -(10**18)
    """When the latest gap in what comes from the server ended."""
    _first_ns: int = 0
    _last_ns: int = 0

    def begin(self) -> None:
        """Count from here: what came while things were starting is none of the figures."""
        self._missing_at_begin = self._stream.counts.missing
        self.messages = self.repeated = self.not_finite = self.unknown = 0
        del self._positions[:-1]
        self._missing_ns.clear()
        self.ages_ns.clear()
        self.tcp_ages_ns.clear()
        self._first_ns = self._last_ns

    def take_frame(self, frame: DataMessage, now_ns: int) -> None:
        """A frame came from the server."""
        if frame.flags & DataFlag.GAP:
            self._gap_ns = frame.monotonic_ns
        before, self._stream.rate_hz = self._stream.counts.missing, self.rate_hz
        kind = self._stream.take(frame.sequence, frame.monotonic_ns, frame.flags)
        if missing := self._stream.counts.missing - before:
            step = (frame.monotonic_ns - self._passed_ns) / (missing + 1)
            self._missing_ns += [self._passed_ns + step * n for n in range(1, missing + 1)]
        if kind is not FrameKind.NEW:
            return
        size = len(frame.process_data)
        decoder = self._decoders.get(size) or self._decoders.setdefault(size, SampleDecoder(size))
        self.latest = decoder.decode(frame.process_data)
        self._samples += 1
        self._passed_ns = frame.monotonic_ns
        self._made_ns.append(frame.monotonic_ns)
        self.tcp_ages_ns.append(now_ns - frame.monotonic_ns)
        values = tuple(self.latest.array)
        self._known[values] = Known(self._samples, frame.monotonic_ns)
        self._order.append(values)
        if len(self._order) > _REMEMBERED:
            old = self._order.popleft()
            if old in self._known and self._known[old].position <= self._samples - _REMEMBERED:
                del self._known[old]
        if self._waiting:
            self._look_up_waiting()

    def take_message(self, values: Sequence[float], now_ns: int) -> None:
        """A message came on the ROS topic."""
        if not all(map(math.isfinite, values)):
            self.not_finite += 1
        self._waiting.append((tuple(values), now_ns))
        self._look_up_waiting()

    def _look_up_waiting(self) -> None:
        while self._waiting:
            values, arrived_ns = self._waiting[0]
            known = self._known.get(values)
            if known is not None:
                self._count(known, arrived_ns)
            elif self._passed_ns <= arrived_ns:
                return  # its sample may still come
            elif self._positions:  # before the first match the two streams need not overlap
                self.messages += 1
                # Where samples were withheld from the server's client, this one may be among them.
                self.unknown += arrived_ns > self._gap_ns + _AROUND_A_GAP_NS
            self._waiting.popleft()

    def _count(self, known: Known, arrived_ns: int) -> None:
        if not self._positions:
            self._first_ns = arrived_ns
        elif known.position <= self._positions[-1]:
            self.repeated += 1
        self.messages += 1
        self._last_ns = arrived_ns
        self._positions.append(known.position)
        self.age_ns = arrived_ns - known.monotonic_ns
        self.ages_ns.append(self.age_ns)

    @property
    def began(self) -> bool:
        """Whether messages come that are the server's samples."""
        return bool(self._positions)

    @property
    def lost_before(self) -> int:
        """Samples since `begin` that were lost or withheld before they could become a message."""
        return self._stream.counts.missing - self._missing_at_begin

    @property
    def lost(self) -> int:
        """Samples, from the first message's to the last's, that came from the server but not on the topic."""
        if not self._positions:
            return 0
        return self._positions[-1] - self._positions[0] + 1 - len(set(self._positions))

    def _lost_in(self, stops: Ints) -> int:
        """How many of all that are missing were made in these stops of the machine."""
        missing = set(range(self._positions[0], self._positions[-1])) if self._positions else set()
        made = [*self._missing_ns, *(self._made_ns[n - 1] for n in missing.difference(self._positions))]
        if not made or not self.rate_hz:
            return 0
        part = covered(np.array(made), 1e9 / self.rate_hz, stops)
        return int(np.count_nonzero(part >= COVERED))

    def summary(self, stops: Ints = NO_STOPS) -> Summary:
        """The figures so far; `stops` of the machine, (n, 2), begin and end in CLOCK_MONOTONIC ns."""
        seconds = (self._last_ns - self._first_ns) / 1e9
        matched = len(self._positions)
        return Summary(
            messages=self.messages,
            rate_hz=(matched - 1) / seconds if seconds > 0 else 0.0,
            lost=self.lost,
            lost_before=self.lost_before,
            lost_in_stops=self._lost_in(stops),
            stops=len(stops),
            longest_stop_ms=float((stops[:, 1] - stops[:, 0]).max()) / 1e6 if len(stops) else 0.0,
            repeated=self.repeated,
            age_p50_ms=percentile(self.ages_ns, 0.5) / 1e6,
            age_p99_ms=percentile(self.ages_ns, 0.99) / 1e6,
            tcp_age_p50_ms=percentile(self.tcp_ages_ns, 0.5) / 1e6,
            tcp_age_p99_ms=percentile(self.tcp_ages_ns, 0.99) / 1e6,
            all_finite=self.not_finite == 0,
            all_decoded_right=self.unknown == 0,
        )


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


def percentile(values: Sequence[int], share: float) -> int:
    """The value that `share` of `values` do not exceed; 0 if there are none."""
    if not values:
        return 0
    ordered = sorted(values)
    return ordered[min(int(len(ordered) * share), len(ordered) - 1)]


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
