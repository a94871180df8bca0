"""What the demo measures: every ROS message is looked up among the server's samples.

The demo has a TCP connection of its own to the server. A ROS message carries no time, so its age and
whether it was decoded right follow from the sample with exactly the same twelve values. No sockets, no ROS.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from protocol.accounting import FrameKind, StreamAccounting
from protocol.framing import DataFlag, DataMessage
from protocol.pdo import Sample, SampleDecoder

_REMEMBERED: Final = 8192
"""Samples that are remembered: some seconds' worth."""
_AROUND_A_GAP_NS: Final = 1_000_000_000
"""So long after samples were withheld a message may still be of one of them."""
FULL_RATE: Final = 0.95
"""Fewer messages than this part of the samples: something could not keep up."""
_LEAST_RATE: Final = 0.6
"""Fewer than this part, and something is wrong."""

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
    _samples: int = 0
    _stream: StreamAccounting = field(default_factory=StreamAccounting)
    _missing_at_begin: int = 0
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
        self.ages_ns.clear()
        self.tcp_ages_ns.clear()
        self._first_ns = self._last_ns

    def take_frame(self, frame: DataMessage, now_ns: int) -> None:
        """A frame came from the server."""
        if frame.flags & DataFlag.GAP:
            self._gap_ns = frame.monotonic_ns
        kind = self._stream.take(frame.sequence, frame.monotonic_ns, frame.flags)
        if kind is not FrameKind.NEW:
            return
        size = len(frame.process_data)
        decoder = self._decoders.get(size) or self._decoders.setdefault(size, SampleDecoder(size))
        self.latest = decoder.decode(frame.process_data)
        self._samples += 1
        self._passed_ns = frame.monotonic_ns
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

    def summary(self) -> Summary:
        """The figures so far."""
        seconds = (self._last_ns - self._first_ns) / 1e9
        matched = len(self._positions)
        return Summary(
            messages=self.messages,
            rate_hz=(matched - 1) / seconds if seconds > 0 else 0.0,
            lost=self.lost,
            lost_before=self.lost_before,
            repeated=self.repeated,
            age_p50_ms=percentile(self.ages_ns, 0.5) / 1e6,
            age_p99_ms=percentile(self.ages_ns, 0.99) / 1e6,
            tcp_age_p50_ms=percentile(self.tcp_ages_ns, 0.5) / 1e6,
            tcp_age_p99_ms=percentile(self.tcp_ages_ns, 0.99) / 1e6,
            all_finite=self.not_finite == 0,
            all_decoded_right=self.unknown == 0,
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
