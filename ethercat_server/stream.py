"""One sensor's stream: which exchanges brought a new sample, and the DATA frame for it.

A frame exists for every new sample. While the sensor is silent there is one REPEATED (or INVALID)
frame for each sample period that passes, so that its silence is visible; the polls in between samples, which
find the same data again only because the bus is read more often than the sensor samples, make none.
"""

from __future__ import annotations

import logging
import time
from typing import Any, Final

from ethercat_server.distribution import RecentDistribution
from ethercat_server.sample_clock import PLAUSIBLE_PULL, SampleClock
from protocol.framing import DataFlag, encode_data, encode_data_head

DISCARDED_AT_START: Final = 3
"""Bota's own driver throws the first three frames after entering OP away."""
_ODD_SECONDS: Final = 10
"""A rate is odd when it has been for so long: a busy machine makes it seem so for a moment."""
_IDLE_PERIODS: Final = 3.0
"""A sensor that has given nothing new for this many periods is silent, not just late."""

log = logging.getLogger(__name__)

REPEATED, INVALID, GAP = (int(flag) for flag in (DataFlag.REPEATED, DataFlag.INVALID, DataFlag.GAP))


class SensorStream:
    """Numbers, stamps and marks the frames of the sensor at `place`, which samples every `period_ns`."""

    def __init__(self, place: int, period_ns: float) -> None:
        self.place = place
        self.clock = SampleClock(period_ns, time.monotonic_ns())
        self.process_data = b""
        """The newest valid process data."""
        self._handed_out = b""
        """What the last frame carried: a REPEATED or INVALID one carries it again."""
        self.alive = True
        """False while the sensor is lost: what the bus gives for it is not its own."""
        self.sequence = 0
        self.fresh = 0
        self.repeated = 0
        self.invalid = 0
        self.lost_samples = 0
        self.recoveries = 0
        self.age = RecentDistribution()
        """From the estimated instant of a sample to its hand-out, while locked."""
        self._discard = DISCARDED_AT_START
        self._gap = False
        self._head = b""
        self._head_wkc = self._head_from_ns = 0
        self._head_until_ns = 0.0
        self._seen = (0, 0, False, False)
        """The last exchange, as `learn` needs it: sent, back, valid, fresh."""
        self._odd_rate_said = False
        self._odd_seconds = 0
        self._valid_ns = 0
        self._idle_at_ns = 0.0

    def prepare(self, sent_ns: int, wkc: int) -> None:
        """While an exchange is on its way: the head of its frame, if all will be as usual.

        That is: complete with the working counter `wkc`, and with the sample that is due.
        """
        clock = self.clock
        until = self._head_until_ns = 0.0 if self._discard or self._gap else clock.foresee(sent_ns)
        if until > sent_ns:
            moment_ns = int(clock.instant_ns)
            self._head_wkc, self._head_from_ns = wkc, moment_ns
            stamp_ns = time.time_ns() - (time.monotonic_ns() - moment_ns)
            self._head = encode_data_head(
                self.sequence, stamp_ns, moment_ns, self.place, 0, wkc, len(self.process_data)
            )

    @property
    def frame_was_prepared(self) -> bool:
        """Whether the last exchange gave the frame that was prepared."""
        return bool(self._head_until_ns)

    def take(
        self, data: bytes, wkc: int, valid: bool, sent_ns: int, back_ns: int
    ) -> tuple[bytes, int] | None:
        """The frame that an exchange gives, and its flags; None if it gives none. `learn` must follow.

        `sent_ns` and `back_ns` are CLOCK_MONOTONIC before and after the exchange.
        """
        clock = self.clock
        moment_ns = back_ns
        fresh = valid and data != self.process_data
        self._seen = sent_ns, back_ns, valid, fresh
        if valid:
            self._valid_ns = back_ns
        if fresh and wkc == self._head_wkc and self._head_from_ns <= back_ns < self._head_until_ns:
            self.process_data = self._handed_out = data
            self.sequence += 1
            return self._head + data, 0
        self._head_until_ns = 0.0
        if fresh:
            self.process_data = data
            if self._discard:
                self._discard -= 1
                self._idle_at_ns = back_ns + _IDLE_PERIODS * clock.period_ns
                return None
            self._handed_out = data
            clock.predict(sent_ns, back_ns)
            flags = self._new_sample(back_ns)
            # After a stall in the exchange its end says nothing of when the sample came to be.
            moment_ns = int(clock.instant_ns if clock.locked else min(back_ns, sent_ns + clock.period_ns))
        elif back_ns >= self._idle_at_ns and self.process_data:
            self._discard = 0  # a sensor that is stuck from the start is to be seen too
            self._handed_out = self._handed_out or self.process_data
            # One lost frame is no news: INVALID is what nothing valid came for in two periods.
            flags = self._nothing_new(back_ns - self._valid_ns < 2 * clock.period_ns, back_ns)
        else:
            return None
        stamp_ns = time.time_ns() - (time.monotonic_ns() - moment_ns)
        sequence = self.sequence
        self.sequence += 1
        return encode_data(
            sequence, stamp_ns, moment_ns, self.place, flags, max(wkc, 0), self._handed_out
        ), flags  # fmt: skip

    def learn(self) -> None:
        """What the last exchange teaches, which can wait until its frame is on its way."""
        sent_ns, back_ns, valid, fresh = self._seen
        if not valid:
            self.clock.missed(sent_ns)
            return
        locked = self.clock.locked
        self.clock.observe(sent_ns, back_ns, fresh)
        if self.frame_was_prepared:
            self._new_sample(back_ns)
        if fresh and locked:
            self.age.record(back_ns - int(self.clock.instant_ns))

    def _new_sample(self, now_ns: int) -> int:
        self._idle_at_ns = now_ns + _IDLE_PERIODS * self.clock.period_ns
        self.fresh += 1
        lost = self.clock.steps - 1 if self.sequence else 0
        # -1 takes back one that was counted after a stall but came after all.
        self.lost_samples = max(0, self.lost_samples + lost)
        flags = GAP if lost > 0 or self.clock.uncertain or self._gap else 0
        self._gap = False
        return flags

    def _nothing_new(self, valid: bool, now_ns: int) -> int:
        # The next slot is counted from this one, but a stall makes one frame, not a burst.
        self._idle_at_ns = max(self._idle_at_ns + self.clock.period_ns, float(now_ns))
        if valid:
            self.repeated += 1
            return REPEATED
        self.invalid += 1
        return INVALID

    def check_rate(self) -> None:
        """To be called once a second: say once if the sensor samples at another rate than it is set to."""
        pull = self.clock.pull
        odd = self.clock.locked and abs(pull) > PLAUSIBLE_PULL
        self._odd_seconds = self._odd_seconds + 1 if odd else 0
        if self._odd_seconds == _ODD_SECONDS and not self._odd_rate_said:
            self._odd_rate_said = True
            log.warning(
                "sensor %d samples every %.1f µs, %+.1f %% off what it is set to: check its settings",
                self.place, self.clock.period_ns / 1000, 100 * pull,
            )  # fmt: skip

    def recover(self, period_ns: float | None, *, lost: bool = True) -> None:
        """The sensor is back after it was out; `period_ns` if it entered OP anew, None if it never left."""
        self.recoveries += lost
        self.alive = True
        if period_ns is not None:
            self.clock = SampleClock(period_ns, time.monotonic_ns())
            self._discard = DISCARDED_AT_START
            self._gap = True

    def status(self) -> dict[str, Any]:
        """The sensor's part of the `status` reply, but for the age."""
        return {
            "sensor": self.place,
            "fresh": self.fresh,
            "repeated": self.repeated,
            "invalid": self.invalid,
            "lost_samples": self.lost_samples,
            "recoveries": self.recoveries,
            "clock": self.clock.describe(),
        }
