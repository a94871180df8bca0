"""One sensor's stream: which exchanges brought a new sample, and the DATA frame for it.

A frame exists for every new sample. While the sensor has nothing new, there is one REPEATED (or INVALID)
frame for each sample period that passes, so that a silent sensor is visible; the polls in between, which
find the same data again only because the bus is read more often than the sensor samples, make none.
"""

from __future__ import annotations

import time
from typing import Any, Final

from protocol.framing import DataFlag, encode_data

DISCARDED_AT_START: Final = 3
"""Bota's own driver throws the first three frames after entering OP away."""
_IDLE_PERIODS: Final = 1.5

REPEATED, INVALID, GAP = (int(flag) for flag in (DataFlag.REPEATED, DataFlag.INVALID, DataFlag.GAP))


class SensorStream:
    """Numbers and marks the frames of the sensor at `place`, which samples at `rate_hz`."""

    def __init__(self, place: int, rate_hz: float) -> None:
        self.place = place
        self.period_ns = round(1e9 / rate_hz)
        self.process_data = b""
        """The newest valid process data."""
        self.sequence = 0
        self.fresh = 0
        self.repeated = 0
        self.invalid = 0
        self.lost_samples = 0
        self.recoveries = 0
        self._discard = DISCARDED_AT_START
        self._gap = False
        self._fresh_at_ns = 0
        self._idle_at_ns = time.monotonic_ns() + self.period_ns

    def take(self, process_data: bytes, wkc: int, valid: bool, now_ns: int) -> tuple[bytes, int] | None:
        """The frame that an exchange gives, and its flags; None if it gives none.

        `now_ns` is CLOCK_MONOTONIC when the process data came back.
        """
        if valid and process_data != self.process_data:
            self.process_data = process_data
            if self._discard:
                self._discard -= 1
                self._fresh_at_ns = 0
                return None
            flags = self._new_sample(now_ns)
        elif now_ns >= self._idle_at_ns and self.process_data and not self._discard:
            flags = self._nothing_new(valid, now_ns)
        else:
            return None
        stamp_ns = time.time_ns() - (time.monotonic_ns() - now_ns)
        frame = encode_data(
            self.sequence, stamp_ns, now_ns, self.place, flags, max(wkc, 0), self.process_data
        )  # fmt: skip
        self.sequence += 1
        return frame, flags

    def _new_sample(self, now_ns: int) -> int:
        elapsed = now_ns - self._fresh_at_ns
        if self._fresh_at_ns and elapsed > 1.75 * self.period_ns:
            self.lost_samples += round(elapsed / self.period_ns) - 1
            self._gap = True
        self._fresh_at_ns = now_ns
        self._idle_at_ns = now_ns + int(_IDLE_PERIODS * self.period_ns)
        self.fresh += 1
        flags = GAP if self._gap else 0
        self._gap = False
        return flags

    def _nothing_new(self, valid: bool, now_ns: int) -> int:
        # The next slot is counted from this one, but a stall makes one frame, not a burst.
        self._idle_at_ns = max(self._idle_at_ns + self.period_ns, now_ns)
        if valid:
            self.repeated += 1
            return REPEATED
        self.invalid += 1
        return INVALID

    def counters(self) -> dict[str, Any]:
        """The sensor's part of the `status` reply."""
        return {
            "sensor": self.place,
            "fresh": self.fresh,
            "repeated": self.repeated,
            "invalid": self.invalid,
            "lost_samples": self.lost_samples,
            "recoveries": self.recoveries,
        }
