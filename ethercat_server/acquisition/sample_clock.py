"""Follows a sensor's own sampling clock, so that a poll falls right after each sample came to be.

The sensor samples freely; an exchange only tells whether the process data changed since the one before. The
change then happened after the earlier exchange was sent and before the later one was back: a bracket that
is valid however late either of them was. Brackets of successive samples, moved on by the period, are
intersected; what remains is where the next sample is expected. A poll is aimed just after that instant. If it
sees the change it was late, and bounds the instant from above; if it does not it was early, bounds it from
below, and a second one follows at once: a single-gate early-late tracker. As the bounds are let
grow, the poll creeps earlier until it is early once in a while, so it stays at the edge. Stalls and lost
frames only make a bracket wide: they teach nothing wrong.
"""

from __future__ import annotations

from typing import Any, Final

_POLLS_UNLOCKED: Final = 4
"""Exchanges a sample while the clock is unknown."""
_SEARCH_STEPS: Final = 8
"""Exchanges a sample once one is overdue."""
_NARROW: Final = 0.4
"""A bracket narrower than this part of a period contains one instant for certain."""
_WATCHED: Final = 0.9
"""A bracket narrower than this many periods begins with a poll that was early."""
_UNDISTURBED: Final = 1.25
"""A bracket wider than this many periods comes from a stall."""
_NEAR_TO_LOCK: Final = 0.03
_NEAR_TO_HOLD: Final = 0.08
"""A sample is as expected when it moves the estimate by less than this part of a period."""
_SLACK_NS: Final = 500.0
"""How far a period may differ from the estimate: the expected bracket grows by this at each end."""
_SILENT: Final = 8
"""A sensor that has given nothing new for this many periods is no longer followed."""
AIM_NS: Final = 25_000.0
"""Delay of a poll after the expected instant: about the jitter of wake-ups."""
_EARLY_NS: Final = 50_000.0
"""A poll this much before its aim was another sensor's, and is not counted as this one's first."""
_FLIGHT_GAIN: Final = 1 / 64
_HALF: Final = 0.45
_SURELY_ONE: Final = 0.8
"""Only one sample can have come in this part of a period, even if the bracket is somewhat off."""
_UNEVEN: Final = 0.2
"""Exchanges that take so much longer than the shortest on average do not say when a sample came to be."""
_LONGEST_LOOK: Final = 0.5
"""The sensor looks at its data within this part of a period after the frame was sent."""
_CREEP_NS: Final = 150.0
_MAX_CREEP: Final = 0.2
_MIN_WIDTH_NS: Final = 10_000.0
_PHASE_GAIN: Final = 0.5
_PERIOD_GAIN: Final = 0.03
_PERIOD_GAIN_LEAST: Final = 0.001
_PERIOD_LEARNING: Final = 200
"""Samples after which the gain has come down by half."""
_MAX_PULL: Final = 0.12
"""The period may differ from the nominal one by this part. Oscillators are off by 0.0005 at most, but a
simulated sensor that sleeps between its samples is slower by much more."""
PLAUSIBLE_PULL: Final = 0.002
"""A real sensor's period differs from the nominal one by less than this part."""
_MAX_ERROR: Final = 0.1
"""The period learns nothing from what a phase is off by more than this part of it."""
_LOCK_GAIN: Final = 1 / 32
_LOCK_AT: Final = 0.85
_UNLOCK_AT: Final = 0.6


class SampleClock:
    """The sampling clock of one sensor, as far as the exchanges have shown it. Times are CLOCK_MONOTONIC ns.

    Call `observe` after every valid exchange, before it `predict` if that brought a new sample; ask
    `next_poll_ns` when the next exchange is wanted.
    """

    __slots__ = (
        "_doubtful", "_flight_ns", "_high", "_hits", "_learned", "_least_flight_ns", "_low",
        "_nominal_ns", "_polled_ns", "_quality", "_tried_ns", "instant_ns", "locked", "period_ns", "steps",
        "uncertain",
    )  # fmt: skip

    def __init__(self, period_ns: float, start_ns: int = 0) -> None:
        """`period_ns` is the nominal sample period; the first poll is due soon after `start_ns`."""
        self._nominal_ns = period_ns
        self.period_ns = period_ns
        self.locked = False
        self.instant_ns = 0.0
        """Estimated instant of the newest sample, from those before it."""
        self.steps = 1
        """How many samples the newest one is after the one handed out before it: more than 1, some were
        lost; 0, one was counted as lost that was not."""
        self.uncertain = False
        """Whether more may have been lost than `steps` says: the sensor may have looked at its data early or
        late in a slow exchange. The samples after it tell, and their `steps` put it right."""
        self._doubtful = False
        """Whether the bracket may be another sample's: one was `uncertain`, or a frame was lost before the
        rate was known, and no sample was watched since."""
        self._quality = 0.0
        self._learned = 0
        self._hits = 0
        """Samples in a row that the first poll saw."""
        self._polled_ns = start_ns
        """When the last valid exchange was sent."""
        self._tried_ns = start_ns
        """When the last exchange was sent, valid or not."""
        self._flight_ns = 0.0
        """How long an exchange usually takes."""
        self._least_flight_ns = period_ns
        """How long the shortest took: half of it is the least a frame needs to the slave or back."""
        self._low = self._high = 0.0
        """Bracket in which the next sample is expected."""

    @property
    def uncertainty_ns(self) -> float:
        """Half the width of the bracket that the newest sample's instant was estimated from."""
        return (self._high - self._low) / 2 - _SLACK_NS

    @property
    def pull(self) -> float:
        """By what part the period differs from the nominal one."""
        return self.period_ns / self._nominal_ns - 1

    def describe(self) -> dict[str, Any]:
        """What `status` says of it."""
        return {
            "mode": "locked" if self.locked else "oversampling",
            "period_us": self.period_ns / 1000,
            "offset_ppm": round((self._nominal_ns / self.period_ns - 1) * 1e6, 1),
            "uncertainty_us": round(self.uncertainty_ns / 1000, 1) if self.locked else None,
        }

    def next_poll_ns(self) -> float:
        """When the next exchange should be sent, as far as this sensor is concerned."""
        tried_ns = self._tried_ns
        if not self.locked:
            return tried_ns + self.period_ns / _POLLS_UNLOCKED
        # So that the sensor, half-way through the exchange, looks at its data just after the instant.
        # Polls that only ever see the change do not say how late they are: with each in a row the next is
        # aimed earlier by more, until one is early and bounds the instant from below again.
        creep_ns = min(_CREEP_NS * self._hits * self._hits, _MAX_CREEP * self.period_ns)
        first = (self._low + self._high - self._flight_ns) / 2 + AIM_NS - creep_ns
        if self._doubtful:
            first = self._low - self._flight_ns  # early for certain: then the next sample is watched coming
        if tried_ns < first - _EARLY_NS:
            return first
        if tried_ns < self._high:
            return tried_ns  # it was early: again, at once
        overdue = tried_ns > self._high + self.period_ns
        return tried_ns + self.period_ns / (_POLLS_UNLOCKED if overdue else _SEARCH_STEPS)

    def predict(self, sent_ns: int, received_ns: int) -> None:
        """Say of the new sample that an exchange brought what can be said before learning from it.

        Sets `steps`, `uncertain` and `instant_ns`, and nothing else.
        """
        after, period = self._polled_ns, self.period_ns
        unwatched = received_ns - after
        if self._begins_anew(after):
            # Only what fell into the time the sensor was not watched can have been lost.
            self.steps = 1 + int(unwatched // period)
            self.uncertain = unwatched >= period
            self.instant_ns = min(received_ns, sent_ns + period) - min(unwatched, period) / 2
            return
        expected = (self._low + self._high) / 2
        # What makes an exchange longer than the shortest may be before the sensor looks at its data or after.
        looking = _HALF * self._least_flight_ns
        if unwatched < _NARROW * period:
            self.steps = max(0, 1 + round(((after + received_ns) / 2 - expected) / period))
        elif self._doubtful and self.locked and received_ns - looking < self._low - _NEAR_TO_HOLD * period:
            self.steps = 0  # too early for the next one: what was uncertain was the one before it
        else:
            # Several samples may lie in a wide bracket: the newest is the last one due before the exchange.
            # A long exchange was a stall after the frame had left, as far as anybody knows: what it brought
            # is dated from before, never as younger than it may be.
            into = min((received_ns - sent_ns) / 2, _LONGEST_LOOK * period)
            self.steps = max(1, 1 + int((sent_ns + into - expected) // period))
        self.uncertain = unwatched - 2 * looking >= period and (
            not self._trusted
            or received_ns - looking - self._low >= _SURELY_ONE * period
            or received_ns - sent_ns - self._least_flight_ns > _LONGEST_LOOK * period
        )
        self.instant_ns = min(max(expected + (self.steps - 1) * period, after), received_ns)

    @property
    def _trusted(self) -> bool:
        """Whether the next sample comes to be within the bracket for certain."""
        uneven_ns = self._flight_ns - self._least_flight_ns
        return self.locked and not self._doubtful and uneven_ns < _UNEVEN * self.period_ns

    def _begins_anew(self, after: int) -> bool:
        """Whether nothing was expected, or the sensor was watched and silent for longer than a period."""
        return self._high == 0.0 or after > self._high + self.period_ns

    def observe(self, sent_ns: int, received_ns: int, fresh: bool) -> None:
        """Learn from one valid exchange whether it brought a new sample (`fresh`: after `predict`)."""
        took_ns = min(received_ns - sent_ns, self.period_ns)
        self._flight_ns += _FLIGHT_GAIN * (took_ns - self._flight_ns)
        self._least_flight_ns = min(self._least_flight_ns, took_ns)
        if not fresh:
            self._polled_ns = self._tried_ns = sent_ns
            if self.locked and sent_ns > self._high + _SILENT * self.period_ns:
                self.restart()
            return
        after, self._polled_ns, self._tried_ns = self._polled_ns, sent_ns, sent_ns
        watched = received_ns - after < _WATCHED * self.period_ns
        self._doubtful = self.uncertain or (self._doubtful and not watched)
        if self._begins_anew(after):
            self._low, self._high = max(after, received_ns - self.period_ns), float(received_ns)
            self._expect_next()
            return
        self._hits = 0 if watched else self._hits + 1
        moved = (self.steps - 1) * self.period_ns
        low, high = self._low + moved, self._high + moved
        believed = (low + high) / 2
        if after > high:  # the sample came later than was thought possible
            self._low, self._high = low + _PHASE_GAIN * (after - high), high + _PHASE_GAIN * (after - high)
        elif received_ns < low:  # earlier
            self._low = low - _PHASE_GAIN * (low - received_ns)
            self._high = high - _PHASE_GAIN * (low - received_ns)
        else:
            self._low, self._high = max(low, after), min(high, received_ns)
        error = (self._low + self._high) / 2 - believed
        undisturbed = received_ns - after < _UNDISTURBED * self.period_ns
        if undisturbed:
            self._learn_period(error)
        near = _NEAR_TO_HOLD if self.locked else _NEAR_TO_LOCK
        self._judge(undisturbed and abs(error) < near * self.period_ns)
        self._expect_next()

    def missed(self, sent_ns: int) -> None:
        """An exchange brought nothing valid: nothing is learned from it, but the next poll counts from it."""
        self._tried_ns = sent_ns
        self._doubtful |= self._learned < _PERIOD_LEARNING  # the rate is not known well enough to bridge it

    def restart(self) -> None:
        """The sensor's clock starts again (its power was cut, say): keep only what is known of its rate."""
        self.locked = False
        self._quality = 0.0
        self._low = self._high = 0.0

    def _learn_period(self, error_ns: float) -> None:
        pull, most = _MAX_PULL * self._nominal_ns, _MAX_ERROR * self._nominal_ns
        # Quickly while little is known, then ever more steadily.
        self._learned += 1
        gain = max(_PERIOD_GAIN_LEAST, _PERIOD_GAIN / (1 + self._learned / _PERIOD_LEARNING))
        period = self.period_ns + gain * max(-most, min(most, error_ns))
        self.period_ns = max(self._nominal_ns - pull, min(self._nominal_ns + pull, period))

    def _judge(self, as_expected: bool) -> None:
        self._quality += _LOCK_GAIN * (as_expected - self._quality)
        if self.locked:
            self.locked = self._quality > _UNLOCK_AT
        else:
            self.locked = self._quality > _LOCK_AT

    def _expect_next(self) -> None:
        middle, half = (self._low + self._high) / 2, (self._high - self._low) / 2
        half = max(half, _MIN_WIDTH_NS / 2) + _SLACK_NS
        self._low = middle + self.period_ns - half
        self._high = middle + self.period_ns + half
