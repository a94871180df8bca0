"""The instants of a sensor's samples by the event times that its slave controller latches.

A controller with distributed clocks keeps its local time of the moment when the sensor's processor had
written a sample (PDI buffer change event). The frame that reads the sample reads that, too. `LocalClock`
follows the local time on CLOCK_MONOTONIC_RAW, `EventTimes` dates samples by it, once `Trust` says so.
"""

from __future__ import annotations

import math
from typing import Final

from ethercat_server.sampling.constants import CERTAIN, RESOLUTION_NS
from ethercat_server.sampling.observation import DistributedClock, Latched
from ethercat_server.sampling.phase import Phase
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.trust import Trust

_WRAP: Final = 1 << 32  # local times are given modulo this, in ns: 4.3 s
_HALF: Final = 1 << 31
# -- the local clock
_BLOCK: Final = 32  # exchanges of a block; the first ones are shorter
_FIRST_BLOCK: Final = 4
_LEAST_VARIANCE: Final = 4_000.0**2  # of the middle of the shortest round trip
_FIRST_RATE: Final = 200e-6  # standard deviation of the rate's error at first; crystals: 100e-6 at most
_JITTER: Final = 1e-4  # variance that the phase gains, ns² in each ns: 10 ns in a ms
_DRIFT: Final = 1.7e-23  # variance that the rate gains in each ns: 1 ppm in a minute
_EXCESS_GAIN: Final = 1 / 8
_JUMPED: Final = 3  # consecutive contradictions after which the clock has jumped
_BIAS_GAIN: Final = 0.15
_BIASED: Final = 1.0  # mean error, in standard deviations, beyond which the rate has changed
_RATE_STEP: Final = 50e-6  # by about this
# The clock is known after `_KNOWN_BLOCKS` blocks, once its standard deviation is below `_KNOWN_NS` or the
# part `_KNOWN` of the shortest round trip, and until it certainly exceeds that.
_KNOWN_BLOCKS: Final = 12
_KNOWN_NS: Final = 10_000.0
_KNOWN: Final = 1 / 32
# -- events
_SLACK_NS: Final = 5_000  # tolerance between the latched times of an event and of a frame's arrival
_OLDEST: Final = 1.5  # age of the newest event, in periods, beyond which samples have come without events
_ASYMMETRY: Final = 1 / 24  # standard deviation of the outward part of a round trip, as part of the shortest


class LocalClock:
    """Local clock of a slave controller. Local times are whole ns that never wrap, others this computer's.

    Attributes:
        local: local time of the newest exchange, which was back at `back_ns`.
        moved_ns: sum of the corrections that moved all events.
        phase: CLOCK_MONOTONIC_RAW at the local time `local_at`, in steps of a local ns.
        doubt_ns: uncertainty of the phase, once the clock `is_known`.
        excess_ns: what the exchanges that count usually take beyond the shortest.
        short_ns: an exchange that is back sooner is a short one, from which this clock learns.
        restarts: how often it turned out to have jumped, or not to run like a clock.
    """

    def __init__(self, round_trip: RoundTrip) -> None:
        """`round_trip` is that of the bus."""
        self._round_trip = round_trip
        self.local = self.back_ns = 0
        self.moved_ns = self.excess_ns = self.short_ns = 0.0
        self.restarts = -1
        self._restart()

    def _restart(self) -> None:
        self.restarts += 1
        self.is_known = False
        self._blocks = self._contradictions = 0
        self._block = self._left = _FIRST_BLOCK
        self._best_took_ns = math.inf
        self._best_ns, self._best_local = 0.0, 0
        self._took_ns = 0.0  # by the exchange of the last correction
        self.phase = Phase(0.0, 1.0, 0.0, _FIRST_RATE**2, _JITTER, _DRIFT)
        self.local_at = 0  # local time at the phase
        self._bias = self.doubt_ns = 0.0

    def learn(self, sent_ns: int, arrived_ns: int, count: int) -> None:
        """Learn from the exchange that was followed last: sent, and begun to arrive, then.

        It stands for `count` exchanges, of which the others were not learned from.
        """
        took_ns = arrived_ns - sent_ns
        if self.is_known:
            at_ns = self.phase.phase_ns + (self.local - self.local_at) * self.phase.period_ns
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
            excess_ns = best_took_ns - self._round_trip.least_ns
            self.excess_ns += _EXCESS_GAIN * (excess_ns - self.excess_ns)
            self._correct(best_took_ns, excess_ns)
        self.short_ns = self._best_took_ns + self._round_trip.taking_over_ns

    def _correct(self, took_ns: float, excess_ns: float) -> None:
        """Correct it by the best exchange of a block, which took so long, and longer than the shortest."""
        phase = self.phase
        # The position of the slave within the excess is unknown, and the bias may be the same every time.
        variance = excess_ns * excess_ns / 4 + _LEAST_VARIANCE
        if not self._blocks:
            self._blocks = 1
            phase.phase_ns, phase.variance, self.local_at = self._best_ns, variance, self._best_local
            return
        phase.advance(self._best_local - self.local_at)
        self.local_at = self._best_local
        error_ns, deviation_ns = self._best_ns - phase.phase_ns, math.sqrt(phase.variance + variance)
        # A busy machine delays frames on one way more than on the other: it is certain only that a frame was
        # at the slave after it was sent and before it was back. What is beyond contradicts the clock.
        beyond_ns = _excess_over(error_ns, took_ns / 2)
        if abs(beyond_ns) > max(CERTAIN * deviation_ns, self._took_ns / 2):
            self._contradictions += 1
            if self._contradictions == _JUMPED:
                self._restart()
            return
        self._contradictions, self._took_ns = 0, took_ns
        self._bias += _BIAS_GAIN * (_excess_over(error_ns, excess_ns / 2) / deviation_ns - self._bias)
        self._move(beyond_ns)
        before_ns = phase.phase_ns
        phase.correct(error_ns - beyond_ns, variance)
        self.moved_ns += phase.phase_ns - before_ns
        if abs(self._bias) > _BIASED:
            self._bias = 0.0
            phase.period_variance += _RATE_STEP**2
        self._blocks += 1
        if abs(phase.period_ns - 1) > CERTAIN * _FIRST_RATE:
            self._restart()
        else:
            self.doubt_ns = CERTAIN * math.sqrt(phase.variance)
            enough_ns = max(_KNOWN_NS, _KNOWN * self._round_trip.least_ns) * (CERTAIN if self.is_known else 1)
            self.is_known = self._blocks >= _KNOWN_BLOCKS and phase.variance < enough_ns * enough_ns

    def _move(self, by_ns: float) -> None:
        self.phase.phase_ns += by_ns
        self.moved_ns += by_ns


def _excess_over(error_ns: float, limit_ns: float) -> float:
    """By how much the size of an error exceeds a limit, with the sign of the error."""
    return math.copysign(max(0.0, abs(error_ns) - limit_ns), error_ns)


class EventTimes:
    """The event times of one sensor, matched with its samples.

    `observe` every exchange; if it brought a new sample, `date` or `compare` it; then `learn`.

    Attributes:
        instant_ns: of the new sample of the newest exchange; 0 if its event does not say.
        is_doubtful: whether samples may have been lost before it that nobody knows of.
    """

    def __init__(self, clock: DistributedClock, round_trip: RoundTrip, data_offset_ns: int) -> None:
        """`clock` is the slave controller's; `round_trip` that of the bus.

        The process data passes the slave `data_offset_ns` after the frame has arrived there.
        """
        self.local_clock = LocalClock(round_trip)
        self.trust = Trust()
        self.are_trusted = False  # `trust.is_trusted`, read for every sample
        self.instant_ns = 0.0
        self._round_trip = round_trip
        self._set_slave(clock)
        self._data_offset_ns = data_offset_ns
        # Local times of the newest sample's event, and of the newest one that was on trial.
        self._event = self._compared_event = 0
        self._took_ns = 0  # by the newest exchange
        self.is_doubtful = False
        # Whether that event is the next sample's, which came while the frame passed; or certainly its own.
        self._is_next = self._is_certain = False
        self._answers = False  # whether the controller knows the registers

    def _set_slave(self, clock: DistributedClock) -> None:
        self._offset = clock.offset
        self._half_loop_ns = clock.loop_delay_ns / 2
        self._reading_ns = clock.reading_ns

    def retry(self, clock: DistributedClock) -> None:
        """Try them again: another master may have changed the controller's clock, which now is `clock`."""
        if clock.offset != self._offset:
            self.local_clock = LocalClock(self._round_trip)
        self._set_slave(clock)
        self.trust.retry()

    @property
    def _is_in_time(self) -> bool:
        """Whether the newest exchange was no longer away than usual: else the machine was busy meanwhile."""
        return self._took_ns < self._round_trip.patience_ns

    @property
    def _is_evidence(self) -> bool:
        """Whether an event that is not the sample's counts against them all."""
        return self._is_in_time and (self.local_clock.is_known or not self._answers)

    @property
    def variance(self) -> float:
        """Variance of `instant_ns`, without the asymmetry of the round trip."""
        return self.local_clock.phase.variance + RESOLUTION_NS**2

    @property
    def path_delay_ns(self) -> float:
        """Usual round trip of the exchanges that set the local clock, less the slave's loop delay."""
        return self._round_trip.least_ns + self.local_clock.excess_ns - 2 * self._half_loop_ns

    @property
    def lacks_event(self) -> bool:
        """Whether no event is certainly the new sample's of the newest exchange; the local clock is known."""
        return self._answers and self.local_clock.is_known and not (self.instant_ns and self._is_certain)

    def observe(self, latched: Latched, sent_ns: int, back_ns: int, fresh: bool, period_ns: float) -> None:
        """What was latched when a frame passed that was sent and back then.

        `fresh`: it brought a new sample. Exchanges come in the order in which they were sent.
        """
        self.instant_ns, self._is_next, self.is_doubtful = 0.0, False, False
        system, counted, change, counted_too = latched
        self._took_ns, self._answers = back_ns - sent_ns, counted == counted_too == 1
        if not self._answers:
            return
        clock, before = self.local_clock, self.local_clock.local
        expected = before + back_ns - clock.back_ns
        local = expected + (system - self._offset - expected + _HALF) % _WRAP - _HALF
        clock.local, clock.back_ns = local, back_ns
        if not fresh:
            return
        self._event = event = local - ((local - change + _HALF) % _WRAP - _HALF)
        # Local times at which the process data passed the slave: of the frame before, and of this one.
        oldest, newest = before + self._data_offset_ns - _SLACK_NS, local + self._data_offset_ns
        self._is_next = newest < event < local + self._reading_ns and event - period_ns > oldest
        self._is_certain = self._is_next or event <= newest
        if clock.is_known and (self._is_next or oldest < event <= newest + _SLACK_NS):
            at_ns = clock.phase.phase_ns + (local - clock.local_at) * clock.phase.period_ns
            # Else the clock has jumped.
            if sent_ns - clock.doubt_ns < at_ns < back_ns + clock.doubt_ns:
                passed_ns = (local - event) * clock.phase.period_ns + self._is_next * period_ns
                self.instant_ns = at_ns - passed_ns - self._half_loop_ns

    def learn(self, sent_ns: int, arrived_ns: int, count: int = 1) -> None:
        """Learn from the exchange that was observed last, which stands for `count`."""
        if self._answers:
            self.local_clock.learn(sent_ns, arrived_ns, count)

    def date(
        self, expected_ns: float, period_ns: float, variance: float, sent_ns: int, back_ns: int
    ) -> float | None:
        """By how many periods `instant_ns` is later than expected; None if it does not date the sample.

        To be asked for each new sample while they are trusted. `variance` is that of `expected_ns`.
        """
        trust = self.trust
        if self.instant_ns:
            late = (self.instant_ns - expected_ns) / period_ns
            off_ns = abs(late - round(late) if late > -0.5 else late) * period_ns
            doubt_ns = CERTAIN * math.sqrt(variance + self.variance)
            self.is_doubtful = off_ns > doubt_ns or doubt_ns > period_ns / 2
            is_old = sent_ns - self.instant_ns > _OLDEST * period_ns
            # An event after the process data that holds its sample had passed: the event time is wrong.
            is_late = self._is_next and late < -0.5
            # A jump of the local clock by more than half a round trip is noticed by `observe`: a larger
            # difference means that the sensor's own sampling clock has changed.
            if not (is_old or is_late) and not doubt_ns < off_ns < self._took_ns / 2:
                trust.confirm()
                return late
            counts = self._is_in_time and not is_old
        else:
            counts = self._is_evidence
        self.is_doubtful = True
        if counts:
            trust.contradict(back_ns, self.local_clock.restarts)
        self.are_trusted = trust.is_trusted
        return None

    def compare(self, difference_ns: float, variance: float, back_ns: int) -> float:
        """Try them on the new sample: by polling, with this variance, it came so much before `instant_ns`.

        To be called for each new sample while they are not trusted; the exchange was back at `back_ns`.
        Returns the variance of the differences once they are trusted from here on, else 0.
        """
        is_new, self._compared_event = self._event != self._compared_event, self._event
        self.trust.compare(
            difference_ns if self.instant_ns and not self._is_next else None,
            is_new=is_new, counts=self._is_evidence and not self._is_next,
        )  # fmt: skip
        # Polling does not tell where on its way a round trip takes its time.
        asymmetry_ns = _ASYMMETRY * self._round_trip.least_ns
        variance += self.variance + asymmetry_ns * asymmetry_ns
        found = self.trust.judge(variance, back_ns, self.local_clock.restarts)
        self.are_trusted = self.trust.is_trusted
        return found
