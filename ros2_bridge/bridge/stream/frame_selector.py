"""Selects the frames to publish: each new one once and in order. No sockets, no ROS.

The rules it keeps:

- `protocol.accounting` says which frames are new. No other frame is ever selected.
- When a queued frame is older than BACKLOG_NS (this process was stopped, or is slower than the stream),
  all of them are left out, and counted as stale, up to the first frame younger than FRESH_NS.
- Age is CLOCK_MONOTONIC now minus the frame's, if the server's clock is ours. Otherwise it is relative to
  the least such difference seen, which may rise slowly as clocks drift apart.
- With a limit to the rate, the newest of what is queued is selected, whenever the limit allows one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from protocol.accounting import StreamAccounting, StreamCounts
from protocol.framing import DataMessage

BACKLOG_NS: Final = 50_000_000
FRESH_NS: Final = 4_000_000
_LONGEST_SKIP_NS: Final = 250_000_000
"""After this long with nothing fresh the clocks cannot be the same: ages are relative from there."""
_DRIFT_DIVISOR: Final = 5000
"""Two machines' clocks drift apart by less than 1/5000."""


@dataclass(slots=True)
class FrameCounts(StreamCounts):
    """Counts of the sensor's frames since the node started, with what the node itself left out."""

    stale: int = 0
    """New frames not published because newer ones were waiting."""
    limited: int = 0
    """New frames not published because of `publishing_frequency`."""


class FrameSelector:
    """Selects the frames of one connection that are to be published. A new connection needs a new one."""

    def __init__(self, sensor: int, counts: FrameCounts, *, same_clock: bool, limit_hz: float = 0.0) -> None:
        """`same_clock`: the server's CLOCK_MONOTONIC is ours. `limit_hz` 0 is no limit."""
        self._sensor = sensor
        self._counts = counts
        self._limit = RateLimit(limit_hz) if limit_hz > 0 else None
        self.accounting = StreamAccounting(counts)
        self._same_clock = same_clock
        self._offset_ns: int | None = 0 if same_clock else None
        self._now_ns = 0
        self._skipping_since_ns: int | None = None
        self.passed_over: list[DataMessage] = []
        """New frames that the rate limit left out of the last `select`, older than the one selected."""

    def select(self, frames: Sequence[DataMessage], now_ns: int) -> list[DataMessage]:
        """The frames of `frames`, all that were queued, that are to be published, oldest first.

        `now_ns` is CLOCK_MONOTONIC after the last was received.
        """
        fresh = self.accounting.select_new(frames, self._sensor)
        if self._limit is not None:
            self.passed_over = []
        if not fresh:
            return fresh
        newest = fresh[-1]
        age_ns = self._age_ns(newest, now_ns)
        if self._skipping_since_ns is None:
            if age_ns + newest.monotonic_ns - fresh[0].monotonic_ns > BACKLOG_NS:
                self._skipping_since_ns = now_ns
        elif now_ns - self._skipping_since_ns > _LONGEST_SKIP_NS:
            self._same_clock = False
            self._offset_ns = now_ns - newest.monotonic_ns
            age_ns = 0
        if self._skipping_since_ns is not None:
            if age_ns > FRESH_NS:
                self._counts.stale += len(fresh)
                return []
            self._skipping_since_ns = None
            self._counts.stale += len(fresh) - 1
            fresh = [newest]
        if self._limit is not None:
            allowed = self._limit.allows(newest.monotonic_ns)
            self._counts.limited += len(fresh) - allowed
            selected = [newest] if allowed else []
            self.passed_over = fresh[: len(fresh) - len(selected)]
            return selected
        return fresh

    def _age_ns(self, newest: DataMessage, now_ns: int) -> int:
        difference = now_ns - newest.monotonic_ns
        if self._same_clock:
            return difference
        if self._offset_ns is None:
            self._offset_ns = difference
        else:
            self._offset_ns = min(
                self._offset_ns + (now_ns - self._now_ns) // _DRIFT_DIVISOR, difference
            )  # fmt: skip
        self._now_ns = now_ns
        return difference - self._offset_ns


class RateLimit:
    """A token bucket: at most `hz` samples a second on average, and two more in any interval.

    It counts in the samples' own time and begins with half a token to spare, so that a limit equal to the
    stream's rate lets every sample pass although their intervals vary.
    """

    _MOST_CREDIT: Final = 2.0
    """With less, a limit just below the stream's rate would not be reached."""

    def __init__(self, hz: float) -> None:
        self._per_ns = hz / 1e9
        self._credit = 1.5
        self._last_ns: int | None = None

    def allows(self, time_ns: int) -> bool:
        """Whether a sample of this time may pass; counts it if so."""
        if self._last_ns is not None:
            elapsed = max(time_ns - self._last_ns, 0)
            self._credit = min(self._credit + elapsed * self._per_ns, self._MOST_CREDIT)
        self._last_ns = time_ns
        # Slightly less than 1, for rounding: 100 times 1.25 ms at 800 Hz must make 100 tokens.
        if self._credit < 1.0 - 1e-6:
            return False
        self._credit -= 1.0
        return True
