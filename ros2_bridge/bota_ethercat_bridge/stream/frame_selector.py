# SPDX-License-Identifier: Apache-2.0
"""Selects the frames to publish: each new one once and in order. No sockets, no ROS.

The rules it keeps:

- Only new frames come here, each once: `bota_ethercat.accounting` has left out the others.
- Age is CLOCK_MONOTONIC now minus the frame's, compared with what is usual on this connection: where the
  server's clock is another machine's, only differences mean anything.
- When a queued frame is older than usual by BACKLOG_NS (this process was stopped, or is slower than the
  stream), the newest is selected and the others are counted as stale. If it is not fresh either, within
  FRESH_NS of the usual age, more is on the way: everything is stale until it is.
- A stream that does not catch up is not behind: its age is the usual one from then on.
- With a limit to the rate, the newest of what is queued is selected, whenever the limit allows one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from bota_ethercat.accounting import StreamCounts
from bota_ethercat.framing import DataMessage

BACKLOG_NS: Final = 50_000_000
FRESH_NS: Final = 4_000_000
# After a stall the age must fall by half of this per such time: then the backlog is being read.
_CATCH_UP_NS: Final = 20_000_000
# The usual age follows each age with these weights (1/n): a low expectile, as delays only add.
_FALL, _RISE = 8, 64


@dataclass(slots=True)
class FrameCounts(StreamCounts):
    """Counts of the sensor's frames since the node started, with what the node itself left out."""

    stale: int = 0  # new frames not published because newer ones were waiting
    limited: int = 0  # new frames not published because of `publishing_frequency`


class FrameSelector:
    """Selects the frames of one connection that are to be published. A new connection needs a new one."""

    def __init__(self, counts: FrameCounts, *, same_clock: bool, limit_hz: float = 0.0) -> None:
        """`same_clock`: the server's CLOCK_MONOTONIC is ours. `limit_hz` 0 is no limit."""
        self._counts = counts
        self._limit: RateLimit | None
        self.limit(limit_hz)
        self._may_be_negative = not same_clock
        self._usual_ns: int | None = None  # the usual age; None before the first frame
        # While everything is stale: the time of the last check of the age, and the age.
        self._skipping: tuple[int, int] | None = None
        # New frames that the rate limit left out of the last `select`, older than the one selected.
        self.passed_over: Sequence[DataMessage] = ()

    def limit(self, hz: float) -> None:
        self._limit = RateLimit(hz) if hz > 0 else None

    def select(self, fresh: Sequence[DataMessage], now_ns: int) -> Sequence[DataMessage]:
        """Those of the new frames, one or more, all that were queued, that are to be published, in order.

        `now_ns` is CLOCK_MONOTONIC after the last was received.
        """
        if self.passed_over:
            self.passed_over = ()
        if not fresh:
            return fresh
        newest = fresh[-1]
        age_ns = now_ns - newest.monotonic_ns
        usual_ns = self._usual_ns
        if usual_ns is None:  # an old one is no rule, where it is known to be old
            is_usual = self._may_be_negative or 0 < age_ns <= BACKLOG_NS
            usual_ns = self._usual_ns = age_ns if is_usual else 0
        late_ns = age_ns - usual_ns
        if self._skipping is None and now_ns - fresh[0].monotonic_ns - usual_ns <= BACKLOG_NS:
            if late_ns < 0 or len(fresh) == 1:  # a later one that was not waited for is late by this node
                self.is_on_time(newest, now_ns)
        else:
            fresh = self._after_stall(fresh, age_ns, now_ns)
            if not fresh:
                return fresh
        limit = self._limit
        if limit is not None:
            allowed = limit.allows(newest.monotonic_ns)
            self._counts.limited += len(fresh) - allowed
            selected = [newest] if allowed else []
            self.passed_over = fresh[: len(fresh) - len(selected)]
            return selected
        return fresh

    def is_on_time(self, alone: DataMessage, now_ns: int) -> bool:
        """Whether this frame, which was waited for, is hardly older than usual, as nearly all are.

        If it is, `select` returns it, unless there is a limit; if not, nothing was done.
        """
        usual_ns = self._usual_ns
        if usual_ns is None or self._skipping is not None:
            return False
        late_ns = now_ns - alone.monotonic_ns - usual_ns
        if late_ns > BACKLOG_NS:
            return False
        usual_ns += late_ns // (_FALL if late_ns < 0 else _RISE)
        self._usual_ns = usual_ns if usual_ns > 0 or self._may_be_negative else 0
        return True

    def _after_stall(self, fresh: Sequence[DataMessage], age_ns: int, now_ns: int) -> list[DataMessage]:
        """The newest of `fresh`, or nothing while more is on the way; `age_ns` is its age."""
        if self._skipping is None:
            self._skipping = now_ns, age_ns
        if age_ns - (self._usual_ns or 0) > FRESH_NS:
            since_ns, was_ns = self._skipping
            passed_ns = now_ns - since_ns
            if passed_ns < _CATCH_UP_NS or was_ns - age_ns >= passed_ns // 2:
                if passed_ns >= _CATCH_UP_NS:
                    self._skipping = now_ns, age_ns
                self._counts.stale += len(fresh)
                return []
            self._usual_ns = age_ns
        self._skipping = None
        self._counts.stale += len(fresh) - 1
        return [fresh[-1]]


class RateLimit:
    """A token bucket of two: at most `hz` samples a second on average, and two more in any interval.

    It counts in the samples' own time and begins with half a token to spare, so that a limit equal to the
    stream's rate lets every sample pass although their intervals vary.
    """

    def __init__(self, hz: float) -> None:
        self._period_ns = 1e9 / hz
        self._full_ns = math.inf  # when both tokens are there again

    def allows(self, time_ns: int) -> bool:
        """Whether a sample of this time may pass; counts it if so."""
        missing = max(0.0, (self._full_ns - time_ns) / self._period_ns)
        if missing > 2.1:  # the first sample, or the clock was set back
            missing = 0.5
        # Slightly more than 1, for rounding: 100 times 1.25 ms at 800 Hz must make 100 tokens.
        if missing > 1.0 + 1e-6:
            return False
        self._full_ns = time_ns + (missing + 1.0) * self._period_ns
        return True
