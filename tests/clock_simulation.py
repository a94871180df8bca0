"""A SampleClock against a simulated machine, network card and sensor, event by event, from a seed.

Polls and answers come in the order in which `Cycle` would handle them, without the rest of the server: a
simulated second takes some hundredths of one. What really happened is kept beside what the clock said.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from ethercat_server.sampling.observation import DistributedClock, Latched
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock, learn, learn_short_exchange
from ethercat_server.sampling.slave_clock import EventTimes

SECOND: Final = 1e9
_SEND_NS: Final = 8_000.0
_DISTRIBUTED: Final = DistributedClock(0, 0, 20_000)
_HAND_OUT_NS: Final = 30_000.0  # what the program needs for a poll, and for an answer


@dataclass(frozen=True)
class Machine:
    """How the program gets to run. Times in ns."""

    wake_ns: float = 12_000.0  # mean lateness of a wake-up; exponentially distributed
    stolen: float = 0.0  # fraction of the time that others take
    steal_ns: float = 1_000_000.0  # mean time that they take at once; exponentially distributed
    # Additional stalls: when, in s from the start, and for how long.
    stops: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Card:
    """What an exchange takes. Answers come in the order of the polls."""

    round_trip_ns: float = 110_000.0
    spread: float = 0.25  # standard deviation of the logarithm of the round trip; 0: constant
    jitter_ns: float = 0.0  # up to this much on top, where it is constant; uniformly distributed
    excess_ns: float = 0.0  # on top of all exchanges except one in 1000
    outward: float = 0.5  # fraction of it before the sensor looks
    lost: float = 0.0  # chance that an exchange does not come back

    def exchange(self, chance: random.Random) -> tuple[float, float]:
        """From sending until the sensor looks at its data, and until the answer is there, in ns."""
        if self.spread:
            took_ns = self.round_trip_ns * math.exp(chance.gauss(0, self.spread))
            return took_ns * chance.uniform(1 / 3, 2 / 3), took_ns
        extra_ns = chance.uniform(0, self.jitter_ns)
        excess_ns = self.excess_ns if chance.random() > 1 / 1000 else 0.0
        outward_ns = self.round_trip_ns / 2 + extra_ns * chance.random() + excess_ns * self.outward
        return outward_ns, self.round_trip_ns + extra_ns + excess_ns


@dataclass(frozen=True)
class Sensor:
    """When samples come to be. Times in ns where nothing else is said."""

    rate_hz: float = 1600.0
    ppm: float = -300.0  # by how much it samples faster than its nominal rate
    ppm_per_minute: float = -1.0  # change of that with its temperature
    white_ns: float = 0.0  # standard deviation of each instant alone
    # Mean excess of each period, as of a program that sleeps in between; gamma distributed.
    sleep_ns: float = 0.0
    scatter: float = 0.0  # each period differs by up to this part of it: 0.9 is no clock at all
    silent_s: tuple[float, float] = (math.inf, math.inf)  # no samples between these
    restart_s: float = math.inf  # the clock starts again with another phase

    def instants(self, chance: random.Random) -> Iterator[float]:
        """When they come to be, without end."""
        first_ns = SECOND / self.rate_hz / (1 + self.ppm * 1e-6)
        wander = -self.ppm_per_minute * 1e-6 / (60 * SECOND)
        silent, until = (each * SECOND for each in self.silent_s)
        restart, at = self.restart_s * SECOND, chance.random() * first_ns + 1
        while True:
            if not silent <= at < until:
                yield at + (chance.gauss(0, self.white_ns) if self.white_ns else 0)
            at += first_ns * (1 + wander * at)
            if self.sleep_ns:
                at += chance.gammavariate(4, self.sleep_ns / 4)
            if self.scatter:
                at += chance.uniform(-self.scatter, self.scatter) * first_ns
            if at > restart:
                at, restart = restart + chance.random() * first_ns, math.inf


@dataclass(frozen=True)
class Controller:
    """A slave controller with a distributed clock, that may lie. Times in ns."""

    ppm: float = 35.0  # by how much its crystal is faster
    step_ppm: float = 0.0  # by how much more from `lies_from_s` on
    start: int = 2**32 - 2_000_000_000  # local time at the start: it wraps after 2 s
    jump_ns: float = 0.0  # step of the local time
    stops: bool = False  # the local time stands still
    stuck: bool = False  # the event time stands still
    late_ns: float = 0.0  # the event time is late; early if negative: that of the buffer's start
    jitter_ns: float = 0.0  # its random error (standard deviation)
    lags: int = 0  # number of samples by which it lags behind
    lies_from_s: float = 0.0  # when all this begins, in s from the start

    def local(self, at_ns: float) -> int:
        """The local time then."""
        since_ns = at_ns - self.lies_from_s * SECOND
        lies = since_ns >= 0
        if lies and self.stops:
            at_ns -= since_ns
        local = self.start + at_ns * (1 + self.ppm * 1e-6)
        if lies:
            local += since_ns * self.step_ppm * 1e-6 + self.jump_ns
        return round(local)

    def latched(self, instants_ns: Sequence[float], number: int, look_ns: float) -> Latched:
        """What a frame reads that is at the slave at `look_ns`, when the sample `number` is the newest."""
        change = 0
        if number >= 0:
            if look_ns < self.lies_from_s * SECOND:
                change = self.local(instants_ns[number])
            else:
                event_ns = instants_ns[max(0, number - self.lags)] + self.late_ns
                if self.jitter_ns:
                    event_ns += random.Random(number).gauss(0, self.jitter_ns)
                change = 0 if self.stuck else self.local(event_ns)
        wrap = 1 << 32
        return self.local(look_ns) % wrap, 1, change % wrap, 1


class Sample(NamedTuple):
    """One that was handed out. Times in ns."""

    number: int  # counted by the sensor, from 0
    instant_ns: float  # true instant
    back_ns: float  # when its exchange was back
    stamp_ns: float
    uncertainty_ns: float  # as the clock gave it
    locked: bool
    steps: int
    uncertain: bool

    @property
    def age_ns(self) -> float:
        """At its hand-out."""
        return self.back_ns - self.instant_ns

    @property
    def error_ns(self) -> float:
        """Of the stamp: positive if it says too late."""
        return self.stamp_ns - self.instant_ns


class Outcome:
    """What a run showed from some time on."""

    def __init__(self, samples: Sequence[Sample], polls: int) -> None:
        self.samples = samples
        self.polls = polls
        pairs = [(after.number - before.number - 1, after) for before, after in pairwise(samples)]
        self.lost = sum(missing for missing, _ in pairs)  # samples that were not handed out
        self.counted = sum(after.steps - 1 for _, after in pairs)  # samples lost by the count of the clock
        # Losses that the clock did not flag.
        self.unflagged = sum(
            missing > 0 and after.steps < 2 and not after.uncertain for missing, after in pairs
        )
        self.unlocked = sum(not sample.locked for sample in samples)
        self.ages_ns = sorted(sample.age_ns for sample in samples)
        self.errors_ns = sorted(abs(sample.error_ns) for sample in samples)
        # Stamps with an error above the uncertainty that the clock gave.
        self.outside = sum(abs(sample.error_ns) > sample.uncertainty_ns for sample in samples)

    @property
    def exchanges(self) -> float:
        """For each sample."""
        return self.polls / len(self.samples)


class Exchange(NamedTuple):
    """On its way, or with what is known once it is back. Times in ns."""

    sent_ns: float
    back_ns: float
    number: int  # of the newest sample when the sensor looked
    latched: Latched | None  # by its controller


class ClockSimulation:
    """One sensor, one card, one machine. Times in ns from the start."""

    def __init__(
        self, sensor: Sensor, card: Card, machine: Machine, seed: int, controller: Controller | None = None
    ) -> None:
        self.card = card
        self.machine = machine
        self.controller = controller
        self.round_trip = RoundTrip()
        events = EventTimes(_DISTRIBUTED, self.round_trip, 0) if controller else None
        self.clock = SampleClock(SECOND / sensor.rate_hz, self.round_trip, events)
        self._sent_ns, self._unanswered, self._in_flight = 0, 0, False
        self._woke_late_ns: float | None = None
        self.now_ns = 1.0
        self.polls_ns: list[float] = []  # when they were sent
        self.samples: list[Sample] = []  # all that were handed out
        self.unlocked_ns: list[float] = []  # when exchanges came back after which the clock was not locked
        # True instants of the samples, by number; the last is in the future.
        self.instants_ns: list[float] = []
        self._chance = random.Random(seed)
        self._instants = sensor.instants(random.Random(seed + 1))
        self._flying: deque[Exchange] = deque()
        self._last_look_ns = self._last_back_ns = 0.0
        self._stops = deque((at_s * SECOND, length_ns) for at_s, length_ns in sorted(machine.stops))
        self._steal_at_ns = math.inf
        self._plan_theft(0.0)
        self._newest(0.0)

    def run(self, until_s: float) -> ClockSimulation:
        """Go on until then; this simulation."""
        clock, flying = self.clock, self._flying
        while self.now_ns < until_s * SECOND:
            poll_ns = clock.next_poll_ns(self._sent_ns, self._unanswered, in_flight=self._in_flight)
            due_ns = int(poll_ns - self.round_trip.late_ns)
            if flying and flying[0].back_ns <= max(due_ns, self.now_ns):
                self.now_ns = max(self.now_ns, self._awake(flying[0].back_ns))
                self._hand_over(flying.popleft())
                self.now_ns += _HAND_OUT_NS
                continue
            if due_ns > self.now_ns:
                self.now_ns = self._awake(due_ns + self._chance.expovariate(1) * self.machine.wake_ns)
                if self._woke_late_ns is None:
                    self._woke_late_ns = self.now_ns - due_ns
            self._send()
            self.now_ns += _SEND_NS
        return self

    def outcome(self, since_s: float) -> Outcome:
        """What the run showed from then on."""
        samples = [sample for sample in self.samples if sample.back_ns > since_s * SECOND]
        return Outcome(samples, sum(at_ns > since_s * SECOND for at_ns in self.polls_ns))

    def _send(self) -> None:
        sent_ns = self.now_ns
        self._sent_ns, self._in_flight = int(sent_ns), True
        self._unanswered += 1
        self.polls_ns.append(sent_ns)
        out_ns, took_ns = self.card.exchange(self._chance)
        if self._chance.random() < self.card.lost:
            return
        self._last_look_ns = max(sent_ns + out_ns, self._last_look_ns)
        self._last_back_ns = max(sent_ns + took_ns, self._last_look_ns, self._last_back_ns)
        look_ns, number = self._last_look_ns, self._newest(self._last_look_ns)
        latched = self.controller.latched(self.instants_ns, number, look_ns) if self.controller else None
        self._flying.append(Exchange(sent_ns, self._last_back_ns, number, latched))

    def _hand_over(self, exchange: Exchange) -> None:
        clock, number = self.clock, exchange.number
        sent, arrived, back = int(exchange.sent_ns), int(exchange.back_ns), int(self.now_ns)
        fresh = number > (self.samples[-1].number if self.samples else -1)
        clock.observe(sent, back, exchange.latched, fresh=fresh)
        if fresh:
            told = clock.uncertainty_ns, clock.locked, clock.steps, clock.uncertain
            self.samples.append(Sample(number, self.instants_ns[number], back, clock.instant_ns, *told))
        self._in_flight, self._unanswered = sent < self._sent_ns, 0
        if clock.learns:
            learn(self.round_trip, [clock], sent, arrived, arrived, self._woke_late_ns)
            self._woke_late_ns = None
        elif clock.events is not None and back - sent < clock.events.local_clock.short_ns:
            learn_short_exchange(self.round_trip, [clock], sent, arrived)
        if clock.events is not None and exchange.latched is not None and clock.events.trust.is_due(back):
            clock.events.retry(_DISTRIBUTED)
        if not clock.locked:
            self.unlocked_ns.append(back)

    def _newest(self, at_ns: float) -> int:
        """Number of the newest sample then; -1 before the first."""
        instants = self.instants_ns
        while not instants or instants[-1] <= at_ns:
            instants.append(next(self._instants))
        return len(instants) - 2

    def _awake(self, at_ns: float) -> float:
        """When the program runs that would at `at_ns`: then, or when it is let."""
        while True:
            if self._stops and at_ns >= self._stops[0][0]:
                at_ns = max(at_ns, sum(self._stops.popleft()))
            elif at_ns >= self._steal_at_ns:
                at_ns = max(at_ns, self._steal_at_ns + self._chance.expovariate(1) * self.machine.steal_ns)
                self._plan_theft(at_ns)
            else:
                return at_ns

    def _plan_theft(self, from_ns: float) -> None:
        if stolen := self.machine.stolen:
            mean_ns = self.machine.steal_ns * (1 - stolen) / stolen
            self._steal_at_ns = from_ns + self._chance.expovariate(1) * mean_ns
