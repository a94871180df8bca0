"""When a sensor's samples came to be, by what its slave controller latches, once that has proved right.

A controller with distributed clocks keeps its local time of the moment when the sensor's processor had
written a sample (PDI buffer change event). The frame that reads the sample reads that, too. `LocalClock`
follows the local time on CLOCK_MONOTONIC, `EventTimes` dates samples by it, and `Trust` decides whether it is
believed. docs/sample-clock.md has the theory. Times are CLOCK_MONOTONIC in ns where nothing else is said,
variances in ns².
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Final

from ethercat_server.acquisition.exchange_timing import ExchangeTiming
from ethercat_server.ethercat.exchange import DistributedClock, Latched

# -- the local clock
_WRAP: Final = 1 << 32  # local times are given modulo this, in ns: 4.3 s
_HALF: Final = 1 << 31
_BLOCK: Final = 32  # exchanges of a block; the first ones are shorter
_FIRST_BLOCK: Final = 4
_LEAST_VARIANCE: Final = 4_000.0**2  # of the middle of the shortest round trip
_FIRST_RATE: Final = 200e-6  # standard deviation of the rate's error at first; crystals: 100e-6 at most
_MOST_RATE: Final = 0.001  # a clock that is further off is none
_JITTER: Final = 1e-4  # variance that the phase gains, ns² in each ns: 10 ns in a ms
_DRIFT: Final = 1.7e-23  # variance that the rate gains in each ns: 1 ppm in a minute
_EXCESS_GAIN: Final = 1 / 8
_CONTRADICTS: Final = 5.0  # standard deviations beyond which a block contradicts the clock
_JUMPED: Final = 3  # consecutive contradictions after which the clock has jumped
_PULL_GAIN: Final = 0.15
_PULLED: Final = 1.0  # mean error, in standard deviations, beyond which the rate has changed
_RATE_STEP: Final = 50e-6  # by about this
# The clock is known after `_KNOWN_BLOCKS` blocks, once its standard deviation is below `_KNOWN_NS` or the
# part `_KNOWN` of the shortest round trip, and until it exceeds that `_STILL` times.
_KNOWN_BLOCKS: Final = 12
_KNOWN_NS: Final = 10_000.0
_KNOWN: Final = 1 / 32
_STILL: Final = 5
# -- trust
_SAMPLES: Final = 100  # samples of a trial at least
_TRIAL_NS: Final = 500_000_000  # duration of a trial at least
# Fraction of them whose events must lie between the frames around the sample. All are in the same clock, so
# right ones always do. One that is off at random does not only where a poll came close, as one in ten does.
_FITTING: Final = 0.99
_MOST_DEVIATIONS: Final = 3.0  # standard deviations by which the mean difference from polling may deviate
_RESTARTS: Final = 3  # restarts of the local clock in one trial beyond which it counts as not running
_MOST_FAILURES: Final = 5  # failed trials after which event times are not used, for a while
_FIRST_PAUSE_NS: Final = 10_000_000_000  # that while at first; it doubles with each trial that fails after it
_LONGEST_PAUSE_NS: Final = 320_000_000_000
_PROVEN_NS: Final = 60_000_000_000  # time trusted after which earlier failures are forgotten
_MOST_CONTRADICTIONS: Final = 4.0  # at which the trust ends
_FORGET: Final = 1 / 100  # part of a contradiction that each sample which fits takes back
# -- events
_SLACK_NS: Final = 5_000  # tolerance between the latched times of an event and of a frame's arrival
_SURE: Final = 5.0  # standard deviations from the estimate beyond which an instant is not used
_OLDEST: Final = 1.5  # age of the newest event, in periods, beyond which samples have come without events
_EVENT_VARIANCE: Final = 3_000.0**2
_ASYMMETRY: Final = 1 / 24  # standard deviation of the outward part of a round trip, as part of the shortest


class LocalClock:
    """Local clock of a slave controller. Local times are whole ns that never wrap, others CLOCK_MONOTONIC.

    Attributes:
        local: local time of the newest exchange, which was back at `back_ns`.
        time_at: CLOCK_MONOTONIC at the local time `local_at`, once the clock `is_known`.
        rate: relative deviation of CLOCK_MONOTONIC from it.
        doubt_ns: uncertainty of `time_at`.
        variance: of `time_at`.
        moved_ns: by how much corrections have moved `time_at`, in all.
        excess_ns: what the exchanges that count usually take beyond the shortest.
        restarts: how often it turned out to have jumped, or not to run like a clock.
    """

    def __init__(self, timing: ExchangeTiming) -> None:
        """`timing` is that of the bus: it knows the shortest round trip."""
        self._timing = timing
        self.local = 0
        self.moved_ns = self.excess_ns = 0.0
        self.back_ns = 0
        self.restarts = -1
        self._restart()

    def _restart(self) -> None:
        self.restarts += 1
        self.is_known = False
        self._took_ns = 0.0  # by the exchange of the last correction
        self.rate = 0.0
        self._blocks = self._contradictions = 0
        self._block = self._left = _FIRST_BLOCK
        self._best_took_ns = math.inf
        self._best_ns, self._best_local = 0.0, 0
        self.time_at, self.local_at = 0.0, 0
        self.variance = self._covariance = 0.0
        self._rate_variance = _FIRST_RATE**2
        self._pull = self.doubt_ns = 0.0

    def learn(self, sent_ns: int, arrived_ns: int, count: int) -> None:
        """Learn from the exchange that was followed last: sent, and begun to arrive, then.

        It stands for `count` exchanges, of which the others were not learned from.
        """
        took_ns = arrived_ns - sent_ns
        if self.is_known:
            at_ns = self.time_at + (self.local - self.local_at) * (1 + self.rate)
            beyond_ns = sent_ns - at_ns if at_ns < sent_ns else min(0.0, arrived_ns - at_ns)
            if abs(beyond_ns) < self._took_ns / 2:  # else it has jumped
                self._move(beyond_ns)
        if took_ns < self._best_took_ns:
            self._best_took_ns = took_ns
            self._best_local, self._best_ns = self.local, sent_ns + took_ns / 2
        self._left -= count
        if self._left <= 0:
            self._block = self._left = min(_BLOCK, self._block + _FIRST_BLOCK)
            best_took_ns, self._best_took_ns = self._best_took_ns, math.inf
            excess_ns = best_took_ns - self._timing.least_ns
            self.excess_ns += _EXCESS_GAIN * (excess_ns - self.excess_ns)
            self._correct(best_took_ns, excess_ns)
        self._timing.short_ns = self._best_took_ns + self._timing.taking_over_ns

    def _correct(self, took_ns: float, excess_ns: float) -> None:
        """Correct it by the best exchange of a block, which took so long, and longer than the shortest."""
        # The position of the slave within the excess is unknown, and the bias may be the same every time.
        variance = excess_ns * excess_ns / 4 + _LEAST_VARIANCE
        if not self._blocks:
            self._blocks = 1
            self.time_at, self.local_at, self.variance = self._best_ns, self._best_local, variance
            return
        passed = self._best_local - self.local_at
        self.time_at += passed + passed * self.rate
        self.local_at = self._best_local
        self.variance += passed * (2 * self._covariance + passed * self._rate_variance + _JITTER)
        self._covariance += passed * self._rate_variance
        self._rate_variance += passed * _DRIFT
        error_ns, total = self._best_ns - self.time_at, self.variance + variance
        # A busy machine delays frames on one way more than on the other: it is certain only that a frame was
        # at the slave after it was sent and before it was back. What is beyond contradicts the clock.
        beyond_ns = _beyond(error_ns, took_ns / 2)
        if abs(beyond_ns) > max(_CONTRADICTS * math.sqrt(total), self._took_ns / 2):
            self._contradictions += 1
            if self._contradictions == _JUMPED:
                self._restart()
            return
        self._contradictions, self._took_ns = 0, took_ns
        self._pull += _PULL_GAIN * (_beyond(error_ns, excess_ns / 2) / math.sqrt(total) - self._pull)
        self._move(beyond_ns)
        error_ns -= beyond_ns
        self._move(error_ns * self.variance / total)
        self.rate += error_ns * self._covariance / total
        self._rate_variance -= self._covariance * self._covariance / total
        self._covariance -= self._covariance * self.variance / total
        self.variance -= self.variance * self.variance / total
        if abs(self._pull) > _PULLED:
            self._pull = 0.0
            self._rate_variance += _RATE_STEP**2
        self._blocks += 1
        if abs(self.rate) > _MOST_RATE:
            self._restart()
        else:
            self.doubt_ns = _CONTRADICTS * math.sqrt(self.variance)
            enough_ns = max(_KNOWN_NS, _KNOWN * self._timing.least_ns) * (_STILL if self.is_known else 1)
            self.is_known = self._blocks >= _KNOWN_BLOCKS and self.variance < enough_ns * enough_ns

    def _move(self, by_ns: float) -> None:
        self.time_at += by_ns
        self.moved_ns += by_ns


def _beyond(error_ns: float, limit_ns: float) -> float:
    """By how much an error exceeds a limit."""
    return math.copysign(max(0.0, abs(error_ns) - limit_ns), error_ns)


class Verdict(Enum):
    """What event times are worth."""

    TRIAL = "on trial"
    TRUSTED = "trusted"
    REFUSED = "refused"


class Trust:
    """Whether the event times of one sensor are believed. Times in ns, variances in ns²."""

    def __init__(self, local_clock: LocalClock) -> None:
        self.local_clock = local_clock
        self.moved = 0  # number of samples with an event of their own
        self.verdict = Verdict.TRIAL
        self.why = ""  # what was wrong with them last: part of a sentence
        self.is_final = False  # whether they are refused for good: the controller has never shown any
        self.was_trusted = False  # whether this controller's ever were: then they are not refused for good
        self._failures = self._again_ns = 0
        self._pause_ns = _FIRST_PAUSE_NS
        self.contradictions = 0.0
        self._since_ns = 0
        self._began = 0, 0  # restarts of the local clock, and samples with an event, at the beginning
        self._compared = self.unfit = 0  # events that could be the sample's, and that could not
        self._sum_ns = self._squares = 0.0

    def confirmed(self) -> None:
        """A sample is dated by its event."""
        if self.contradictions > 0:
            self.contradictions -= _FORGET

    def contradicted(self, now_ns: int) -> None:
        """A sample has no event that can be its own, or none that agrees with the sensor's clock."""
        self.contradictions += 1
        if self.contradictions > _MOST_CONTRADICTIONS:
            if now_ns - self._since_ns > _PROVEN_NS:
                self._failures, self._pause_ns = 0, _FIRST_PAUSE_NS
            self._fail("they contradict the frames or the sensor's own clock", now_ns)
            self.begin(now_ns)

    def begin(self, now_ns: int) -> None:
        """Begin a trial."""
        self._since_ns, self._began = now_ns, (self.local_clock.restarts, self.moved)
        self._compared = self.unfit = 0
        self._sum_ns = self._squares = 0.0

    def is_due(self, now_ns: int) -> bool:
        """Whether they are refused, and the pause has passed: they are to be tried again."""
        return self.verdict is Verdict.REFUSED and not self.is_final and now_ns >= self._again_ns

    def retry(self) -> None:
        """Have another trial begin, though they are refused."""
        self.verdict, self._since_ns = Verdict.TRIAL, 0

    def compare(self, difference_ns: float) -> None:
        """An event is later than polling says by `difference_ns`."""
        self._compared += 1
        self._sum_ns += difference_ns
        self._squares += difference_ns * difference_ns

    @property
    def mean_ns(self) -> float:
        """Mean difference between events and polling in the latest trial."""
        return self._sum_ns / max(self._compared, 1)

    def end(self, variance: float, now_ns: int) -> float:
        """End the trial if it was long enough; `variance` is that of both estimates.

        Returns the variance of the differences between them if they are trusted now, else 0.
        """
        if self.verdict is Verdict.REFUSED:
            return 0.0
        if not self._since_ns:
            self.begin(now_ns)
        if now_ns - self._since_ns < _TRIAL_NS:
            return 0.0
        count, (restarts, moved) = self._compared + self.unfit, self._began
        if self.local_clock.restarts - restarts > _RESTARTS:
            self._refuse("its local clock does not run", now_ns)
            self.is_final = not self.was_trusted
        elif count < _SAMPLES:
            pass
        elif self.moved == moved:
            self._refuse("they stand still", now_ns)
            self.is_final = not self.was_trusted
        elif self._compared < _FITTING * count:
            self._fail("they contradict the frames", now_ns)
            self.begin(now_ns)
        elif abs(self.mean_ns) > _MOST_DEVIATIONS * math.sqrt(variance):
            self._fail(f"they differ from what polling shows by {self.mean_ns / 1000:+.0f} µs", now_ns)
            self.begin(now_ns)
        else:
            self.verdict, self._since_ns = Verdict.TRUSTED, now_ns
            self.was_trusted = True
            self.contradictions = 0.0
            return self._squares / self._compared
        return 0.0

    def _fail(self, why: str, now_ns: int) -> None:
        self._failures += 1
        self.verdict, self.why = Verdict.TRIAL, why
        if self._failures >= _MOST_FAILURES:
            self._refuse(why, now_ns)

    def _refuse(self, why: str, now_ns: int) -> None:
        self.verdict, self.why = Verdict.REFUSED, why
        self._again_ns, self._pause_ns = now_ns + self._pause_ns, min(2 * self._pause_ns, _LONGEST_PAUSE_NS)


class EventTimes:
    """Event times of one sensor: `take` every exchange; if it brought a new sample, `date` or `compare` it;
    then `learn`."""

    def __init__(self, clock: DistributedClock, timing: ExchangeTiming, passing_ns: int) -> None:
        """`clock` is the slave controller's; `timing` that of the bus.

        The process data passes the slave `passing_ns` after the frame has arrived there.
        """
        self.local_clock = LocalClock(timing)
        self.trust = Trust(self.local_clock)
        self.are_trusted = False  # whether samples are dated by them
        # CLOCK_MONOTONIC of the new sample of the newest exchange; 0 if its event does not say.
        self.instant_ns = 0.0
        self._timing = timing
        self._use(clock)
        self._passing_ns = passing_ns
        # Local times of the newest sample's event, and of the newest one that was on trial.
        self._event = self._compared_event = 0
        self._took_ns = 0  # by the newest exchange
        self.is_doubtful = False  # whether samples may have been lost before it that nobody knows of
        self._is_next = False  # whether that event is the next sample's, which came while the frame passed
        self._answers = False  # whether the controller knows the registers

    def _use(self, clock: DistributedClock) -> None:
        self._offset = clock.offset
        self._half_behind_ns = clock.behind_ns / 2
        self._reading_ns = clock.reading_ns

    def retry(self, clock: DistributedClock) -> None:
        """Try them again: another master may have changed the controller's clock, which now is `clock`."""
        if clock.offset != self._offset:
            self.local_clock = self.trust.local_clock = LocalClock(self._timing)
        self._use(clock)
        self.trust.retry()

    @property
    def is_steady(self) -> bool:
        """Whether nothing is being found out about them, or held against them."""
        return self.trust.verdict is not Verdict.TRIAL and self.trust.contradictions <= 0

    @property
    def _is_in_time(self) -> bool:
        """Whether the newest exchange was no longer away than usual: else the machine was busy meanwhile."""
        return self._took_ns < self._timing.patience_ns

    @property
    def _counts(self) -> bool:
        """Whether an event that is not the sample's counts against them all."""
        return self._is_in_time and (self.local_clock.is_known or not self._answers)

    @property
    def variance(self) -> float:
        """Variance of `instant_ns`, in ns², without the asymmetry of the round trip."""
        return self.local_clock.variance + _EVENT_VARIANCE

    @property
    def way_ns(self) -> float:
        """Time of the round trips by which the local clock is known that is not spent behind the slave."""
        return self._timing.least_ns + self.local_clock.excess_ns - 2 * self._half_behind_ns

    @property
    def has_none(self) -> bool:
        """Whether no event is certainly the new sample's of the newest exchange; the local clock is known."""
        return self._answers and self.local_clock.is_known and not (self.instant_ns and self._is_certain)

    def take(self, latched: Latched, sent_ns: int, back_ns: int, fresh: bool, period_ns: float) -> None:
        """Take what was latched when a frame passed that was sent and back then.

        `fresh`: it brought a new sample. Exchanges come in the order in which they were sent.
        """
        self.instant_ns, self._is_next, self.is_doubtful = 0.0, False, False
        system, counted, change, counted_too = latched
        self._took_ns, self._answers = back_ns - sent_ns, counted == counted_too == 1
        if not self._answers:
            return
        clock, before = self.local_clock, self.local_clock.local
        expected = before + back_ns - clock.back_ns
        clock.local = local = expected + (system - self._offset - expected + _HALF) % _WRAP - _HALF
        clock.back_ns = back_ns
        if not fresh:
            return
        self._event = event = local - ((local - change + _HALF) % _WRAP - _HALF)
        # Between these the process data passed: in the frame before, and in this one.
        oldest, newest = before + self._passing_ns - _SLACK_NS, local + self._passing_ns
        self._is_next = newest < event < local + self._reading_ns and event - period_ns > oldest
        self._is_certain = self._is_next or event <= newest
        if clock.is_known and (self._is_next or oldest < event <= newest + _SLACK_NS):
            at_ns = clock.time_at + (local - clock.local_at) * (1 + clock.rate)
            # Else the clock has jumped.
            if sent_ns - clock.doubt_ns < at_ns < back_ns + clock.doubt_ns:
                passed_ns = (local - event) * (1 + clock.rate) + self._is_next * period_ns
                self.instant_ns = at_ns - passed_ns - self._half_behind_ns

    def learn(self, sent_ns: int, arrived_ns: int, count: int = 1) -> None:
        """Learn from the exchange that was taken last, which stands for `count`."""
        if self._answers:
            self.local_clock.learn(sent_ns, arrived_ns, count)

    def date(
        self, expected_ns: float, period_ns: float, variance: float, sent_ns: int, back_ns: int
    ) -> float | None:
        """By how many periods `instant_ns` is later than expected; None if it does not date the sample.

        To be asked for each new sample while they are trusted. `variance` is that of `expected_ns`.
        """
        trust, late = self.trust, 0.0
        if self.instant_ns:
            late = (self.instant_ns - expected_ns) / period_ns
            off_ns = abs(late - round(late) if late > -0.5 else late) * period_ns
            doubt_ns = _SURE * math.sqrt(variance + self.variance)
            self.is_doubtful = off_ns > doubt_ns or doubt_ns > period_ns / 2
            is_old = sent_ns - self.instant_ns > _OLDEST * period_ns
            # If the process data had passed when this sample's own event came, that is late: it lies.
            is_late = self._is_next and late < -0.5
            # A jump of the local clock by more than half a round trip is noticed by `take`: a larger
            # difference means that the sensor's own sampling clock has changed.
            if not (is_old or is_late) and not doubt_ns < off_ns < self._took_ns / 2:
                trust.confirmed()
                return late
            counts = self._is_in_time and not is_old
        else:
            counts = self._counts
        self.is_doubtful = True
        if counts:
            trust.contradicted(back_ns)
        self.are_trusted = trust.verdict is Verdict.TRUSTED
        return None

    def compare(self, difference_ns: float, variance: float, back_ns: int) -> float:
        """Try them on the new sample: by polling, with this variance, it came so much before `instant_ns`.

        To be called for each new sample while they are not trusted; the exchange was back at `back_ns`.
        Returns the variance of the differences once they are trusted from here on, else 0.
        """
        trust = self.trust
        trust.moved += self._event != self._compared_event
        self._compared_event = self._event
        if self._is_next:
            pass
        elif self.instant_ns:
            trust.compare(difference_ns)
        elif self._counts:
            trust.unfit += 1
        # Polling does not tell where on its way a round trip takes its time.
        asymmetry_ns = _ASYMMETRY * self._timing.least_ns
        variance += self.variance + asymmetry_ns * asymmetry_ns
        found = trust.end(variance, back_ns)
        self.are_trusted = trust.verdict is Verdict.TRUSTED
        return found
