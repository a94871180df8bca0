"""The local clock of a slave controller, and the events that it latches, against the rules of both."""

from __future__ import annotations

import itertools
import math
import random
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ethercat_server.sampling.observation import DistributedClock
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.slave_clock import EventTimes, LocalClock

MS = 10**6
WRAP = 2**32


class Textbook:
    """A Kalman filter in matrices that keeps whole blocks of exchanges; docs/sample-clock.md."""

    def __init__(self, bus: Any) -> None:
        self.bus, self.restarts, self.excess_ns, self.moved_ns = bus, -1, 0.0, 0.0
        self.seen = set[str]()
        self.restart()

    def restart(self) -> None:
        self.restarts, self.known, self.blocks, self.against = self.restarts + 1, False, 0, 0
        self.size, self.block, self.weight = 4, list[tuple[int, float, int]](), 0
        self.took_ns = self.bias = self.doubt_ns = 0.0
        self.state, self.covariance, self.at = np.array([0.0, 1.0]), np.diag([0.0, 200e-6**2]), 0

    def learn(self, sent: int, arrived: int, local: int, count: int) -> None:
        took = arrived - sent
        if self.known:  # it was at the slave after it was sent and before it was here
            at = float(self.state[0] + (local - self.at) * self.state[1])
            beyond = min(max(at, sent), arrived) - at
            if abs(beyond) < self.took_ns / 2:
                self.move(beyond)
                self.seen |= {f"moved {'on' if beyond > 0 else 'back'}"} if beyond else set()
        self.block.append((took, sent + took / 2, local))
        self.weight += count
        if self.weight >= self.size:
            best, self.block, self.weight = min(self.block, key=lambda each: each[0]), [], 0
            self.size = min(32, self.size + 4)
            self.excess_ns += (best[0] - self.bus.least_ns - self.excess_ns) / 8
            self.correct(*best)

    @property
    def short_ns(self) -> float:
        return min((took for took, *_ in self.block), default=math.inf) + float(self.bus.taking_over_ns)

    def move(self, by: float) -> None:
        self.state = self.state + np.array([by, 0.0])
        self.moved_ns += by

    def correct(self, took: int, middle: float, local: int) -> None:
        excess = took - self.bus.least_ns
        variance = excess**2 / 4 + 4000.0**2
        if not self.blocks:
            self.blocks, self.at, self.state[0], self.covariance[0, 0] = 1, local, middle, variance
            return
        steps, self.at = local - self.at, local
        ahead = np.array([[1.0, steps], [0.0, 1.0]])
        self.state = ahead @ self.state
        self.covariance = ahead @ self.covariance @ ahead.T + steps * np.diag([1e-4, 1.7e-23])
        error = middle - self.state[0]
        deviation = math.sqrt(self.covariance[0, 0] + variance)
        beyond = error - min(max(error, -took / 2), took / 2)
        if abs(beyond) > max(5.0 * deviation, self.took_ns / 2):
            self.against += 1
            self.seen.add("against")
            if self.against == 3:
                self.restart()
                self.seen.add("jumped")
            return
        self.against, self.took_ns = 0, took
        apart = error - min(max(error, -excess / 2), excess / 2)
        self.bias += 0.15 * (apart / deviation - self.bias)
        self.move(beyond)
        gain = self.covariance[:, 0] / (self.covariance[0, 0] + variance)
        by = gain * (error - beyond)
        self.state, self.moved_ns = self.state + by, self.moved_ns + by[0]
        self.covariance = self.covariance - np.outer(gain, self.covariance[0])
        if abs(self.bias) > 1.0:
            self.bias, self.covariance[1, 1] = 0.0, self.covariance[1, 1] + 50e-6**2
            self.seen.add("biased")
        self.blocks += 1
        if abs(self.state[1] - 1) > 5 * 200e-6:
            self.restart()
            self.seen.add("no clock")
            return
        self.doubt_ns = 5 * math.sqrt(self.covariance[0, 0])
        enough = max(10_000.0, self.bus.least_ns / 32) * (5 if self.known else 1)
        was, self.known = self.known, self.blocks >= 12 and self.covariance[0, 0] < enough**2
        self.seen |= {"known"} if self.known else {"forgotten"} if was else set()
        if self.known and was and self.covariance[0, 0] > (enough / 5) ** 2:
            self.seen.add("doubtful")


QUIET, SLOW, BUSY = (60, 5), (800, 60), (60, 300)


@pytest.mark.parametrize(
    ("bus_us", "ppm", "happens", "seen"),
    [
        (SLOW, -60, {2.0: ("jump_us", 30)}, {"known"}),
        ((60, 2500), 20, {}, {"known"}),
        ((800, 900), 20, {}, {"known"}),
        (SLOW, 1400, {}, {"no clock"}),
        (SLOW, -1400, {}, {"no clock"}),
        (BUSY, 20, {1.9: ("jump_us", 9000)}, {"known", "jumped"}),
        (QUIET, 20, {1.8 + n / 10: ("jump_us", (-75, 75)[n % 2]) for n in range(1, 11)}, {"against"}),
        (QUIET, 0, {1.7: ("jump_us", 45), 2.2: ("jump_us", -45)}, {"moved on", "moved back"}),
        (BUSY, 0, {1.5: ("ppm", 130), 2.0: ("ppm", -90)}, {"moved on", "biased"}),
        (BUSY, 0, {1.5: ("busy_us", 3e3), 1.51: ("pause_ms", 20e3), 23.0: ("busy_us", 0)}, {"doubtful"}),
        (BUSY, 0, {1.5: ("busy_us", 3e3), 1.51: ("pause_ms", 3e5), 303.0: ("busy_us", 0)}, {"forgotten"}),
    ],
)
def test_a_local_clock_is_a_textbook_filter_of_the_best_exchange_of_each_block(
    bus_us: tuple[int, int], ppm: float, happens: dict[float, tuple[str, float]], seen: set[str]
) -> None:
    (round_trip_us, excess_us), draw = bus_us, random.Random(sum(bus_us))
    bus = SimpleNamespace(least_ns=1000 * round_trip_us, taking_over_ns=7000.0)
    clock: Any = LocalClock(cast("RoundTrip", bus))
    expected, now, at, local = Textbook(bus), MS, MS, 10**9
    given, changes = {"ppm": ppm, "busy_us": 0, "jump_us": 0, "pause_ms": 0}, sorted(happens.items())
    for _ in range(1100):
        now += draw.choice((MS // 4, MS, MS, 2 * MS, 9 * MS))
        if changes and now > changes[0][0] * 1e9:
            what, value = changes.pop(0)[1]
            given[what] = value
        now += round(given["pause_ms"] * MS)
        busy = given["busy_us"] + excess_us
        sent, took = now, 1000 * round_trip_us + round(draw.expovariate(1) * 1000 * busy)
        slave = sent + round(draw.random() * (took - 1000 * round_trip_us) + 500 * round_trip_us)
        local += round((slave - at) * (1 + given["ppm"] * 1e-6) + 1000 * given["jump_us"])
        at, given["jump_us"], given["pause_ms"] = slave, 0, 0
        bus.least_ns += draw.choice((-10, 0, 10))
        count, now = draw.choice((1, 1, 1, 5)), now + took
        clock.local, clock.back_ns, blocks = local, now, clock.local_at
        clock.learn(sent, sent + took, count)
        expected.learn(sent, sent + took, local, count)
        found = clock.restarts, clock.is_known, clock.local_at, clock.short_ns
        assert found == (expected.restarts, expected.known, expected.at, expected.short_ns)
        assert abs(clock.phase.phase_ns - expected.state[0]) < 0.5
        assert abs(clock.moved_ns - expected.moved_ns) < 1
        if clock.local_at != blocks:
            assert clock.phase.period_ns == pytest.approx(expected.state[1], rel=0, abs=1e-9)
            assert (clock.phase.variance, clock.doubt_ns, clock.excess_ns) == pytest.approx(
                (expected.covariance[0, 0], expected.doubt_ns, expected.excess_ns), rel=1e-3
            )
    assert (changes, seen - expected.seen) == ([], set())


OFFSET, DATA_NS, LOOP_NS, READING_NS, DOUBT_NS = 3_000_000_123, 9_000, 2_000, 25_000, 700
PERIOD_NS, SLACK_NS, SLOWER = 1_000_000, 5_000, 1.25
FIRST = 3 * 10**9  # just before the local clock wraps


class Frames:
    """Two frames at a slave whose local clock is `ahead` of this computer's and known, and one event."""

    def __init__(self, *, known: bool = True, wraps: str = "local") -> None:
        clock = DistributedClock(OFFSET, LOOP_NS, READING_NS)
        self.events: Any = EventTimes(clock, RoundTrip(), DATA_NS)
        self.ahead = WRAP - FIRST - 100_000 - (OFFSET if wraps == "system" else 0)
        self.local_clock: Any = self.events.local_clock
        self.local_clock.is_known, self.local_clock.doubt_ns = known, float(DOUBT_NS)
        self.local_clock.phase.period_ns = SLOWER

    def pass_at(
        self, at: int, event: int, *, sent: int, back: int, fresh: bool = True, answers: int = 1
    ) -> None:
        """A frame is at the slave `at` and the newest event was then; ns of this computer."""
        self.local_clock.phase.phase_ns, self.local_clock.local_at = at - 10**6, at + self.ahead
        self.local_clock.local_at -= round(10**6 / SLOWER)
        latched = ((at + self.ahead + OFFSET) % WRAP, answers, (event + self.ahead) % WRAP, answers)
        self.events.observe(latched, sent, back, fresh, PERIOD_NS)


@pytest.mark.parametrize(("known", "wraps"), [(True, "local"), (True, "system"), (False, "local")])
@pytest.mark.parametrize("apart", [400_000, 985_000, 1_020_000, 1_400_000])
def test_an_event_dates_the_sample_whose_process_data_passed_after_it(
    apart: int, known: bool, wraps: str
) -> None:
    """Around every edge: the data of the frame before, of this one, and what was read of it."""
    first, second = FIRST, FIRST + apart
    sent, back = second - 40_000, second + 45_000
    passed = second + DATA_NS
    edges = [first + DATA_NS - SLACK_NS, passed, passed + SLACK_NS, second + READING_NS]
    edges.append(first + DATA_NS - SLACK_NS + PERIOD_NS)
    outcomes = set[tuple[bool, bool, bool]]()
    for event, is_fresh in itertools.product((e + by for e in edges for by in (-1, 0, 1)), (True, False)):
        frames = Frames(known=known, wraps=wraps)
        frames.pass_at(first, first - 90_000, sent=first - 40_000, back=first + 45_000)
        frames.events.is_doubtful = True
        frames.pass_at(second, event, sent=sent, back=back, fresh=is_fresh)
        events = frames.events
        assert events.is_doubtful is False
        came_after = passed < event < second + READING_NS
        is_next = is_fresh and came_after and event - PERIOD_NS > first + DATA_NS - SLACK_NS
        is_own = first + DATA_NS - SLACK_NS < event <= passed + SLACK_NS
        instant = second - SLOWER * (second - event) - is_next * PERIOD_NS - LOOP_NS / 2
        instant = instant if is_own or is_next else 0.0
        assert events.instant_ns == (instant if known and is_fresh else 0.0), event
        certain = event <= passed or is_next
        if is_fresh:
            assert events.lacks_event is (known and not (instant and certain)), event
            differences = list[Any]()
            events.trust = SimpleNamespace(
                compare=lambda *told, differences=differences, **more: differences.append((*told, more)),
                judge=lambda *told: told, is_trusted="asked",
            )  # fmt: skip
            events.local_clock.phase.variance = 7.0
            events._round_trip.least_ns = 240_000
            assert events.compare(5.0, 1.0, back) == (1.0 + 7.0 + 3000.0**2 + 10_000.0**2, back, 0)
            assert events.are_trusted == "asked"
            counts = known and not is_next
            own = 5.0 if known and instant and not is_next else None
            assert differences == [(own, {"is_new": True, "counts": counts})], event
            outcomes.add((is_own, is_next, certain))
    assert len(outcomes) >= 3


def test_a_local_time_outside_of_its_exchange_by_more_than_its_doubt_dates_nothing() -> None:
    for sent, back in itertools.product((-40_000, DOUBT_NS - 1, DOUBT_NS), (45_000, 1 - DOUBT_NS, -DOUBT_NS)):
        frames, at = Frames(), FIRST + PERIOD_NS
        frames.pass_at(FIRST, FIRST - 90_000, sent=FIRST - 40_000, back=FIRST + 45_000)
        frames.pass_at(at, at - 7, sent=at + sent, back=at + back)
        assert bool(frames.events.instant_ns) is (sent < DOUBT_NS and back > -DOUBT_NS)


def test_a_frame_without_an_answer_of_the_controller_says_nothing() -> None:
    frames, at = Frames(), FIRST
    for at in (FIRST, FIRST + PERIOD_NS):
        frames.pass_at(at, at + DATA_NS + 10_000, sent=at - 9, back=at + 9)
    local, events, learned = frames.local_clock.local, frames.events, list[tuple[int, ...]]()
    frames.local_clock.learn = lambda *told: learned.append(told)
    dated = at + SLOWER * (DATA_NS + 10_000) - PERIOD_NS - 1_000
    assert (events.instant_ns, events._is_next) == (dated, True)
    for answers in (0, 2):
        frames.pass_at(at + PERIOD_NS, at, sent=at, back=at + 9, answers=answers)
        assert (events.instant_ns, events._is_next, events.lacks_event) == (0.0, False, False)
        assert frames.local_clock.local == local
        events.learn(at, at + 9)
    frames.pass_at(at + PERIOD_NS, at + PERIOD_NS, sent=at, back=at + 2 * PERIOD_NS)
    events.learn(at, at + 9)
    events.learn(at, at + 9, 3)
    assert (frames.local_clock.local, learned) == (local + PERIOD_NS, [(at, at + 9, 1), (at, at + 9, 3)])


DUE, DEVIATION = 50_000_000.0, 4_000.0  # 5 standard deviations: 20 µs; half of a round trip: 30 µs


@pytest.mark.parametrize(
    ("late_ns", "given", "late", "doubtful", "against"),
    [
        pytest.param(3_000, {}, 0.003, False, 0, id="as expected"),
        pytest.param(20_000, {}, 0.02, False, 0, id="just so"),
        pytest.param(20_001, {}, None, True, 1, id="it contradicts the sampling clock"),
        pytest.param(30_000, {}, 0.03, True, 0, id="by half a round trip: the sampling clock has changed"),
        pytest.param(2_025_000, {}, None, True, 1, id="two lost, which contradicts"),
        pytest.param(-300_000, {"took": 700_000}, None, True, 1, id="which contradicts"),
        pytest.param(700_000, {"took": 1_000_000}, None, True, 1, id="early, after one lost"),
        pytest.param(-700_000, {"took": 1_000_000}, -0.7, True, 0, id="the sample before, again"),
        pytest.param(-700_000, {"took": 1_000_000, "next": True}, None, True, 1, id="which it is not"),
        pytest.param(-500_000, {"took": 1_000_000, "next": True}, -0.5, True, 0, id="half a period"),
        pytest.param(3_000, {"deviation": 100_001.0}, 0.003, True, 0, id="less"),
        pytest.param(3_000, {"sent": 1_503_000}, 0.003, False, 0, id="so old may it be"),
        pytest.param(3_000, {"sent": 1_503_001}, None, True, 0, id="older"),
        pytest.param(25_000, {"busy": True}, None, True, 0, id="contradicts, on a busy machine"),
        pytest.param(None, {}, None, True, 1, id="no event"),
        pytest.param(None, {"known": False}, None, True, 0, id="none, the local clock is not known"),
        pytest.param(None, {"known": False, "answers": False}, None, True, 1, id="no answer"),
    ],
)
def test_what_a_trusted_event_says_of_its_sample(
    late_ns: int | None, given: dict[str, Any], late: float | None, doubtful: bool, against: int
) -> None:
    events: Any = EventTimes(DistributedClock(0, 0, 0), RoundTrip(), 0)
    told = list[Any]()
    events.trust = SimpleNamespace(
        confirm=lambda: told.append("fits"), contradict=lambda *which: told.append(which), is_trusted="asked"
    )
    took, deviation = given.get("took", 60_000), given.get("deviation", DEVIATION)
    events._took_ns, events._is_next = took, given.get("next", False)
    events._answers = given.get("answers", True)
    events._round_trip = SimpleNamespace(patience_ns=took if given.get("busy") else took + 1)
    events.local_clock = SimpleNamespace(
        is_known=given.get("known", True), phase=SimpleNamespace(variance=3e6), restarts=6
    )
    events.instant_ns = 0.0 if late_ns is None else DUE + late_ns
    found = events.date(DUE, 1e6, deviation**2 - 3e6 - 3_000.0**2, round(DUE) + given.get("sent", 0), 77)
    assert found == (None if late is None else pytest.approx(late, abs=1e-9))
    assert events.is_doubtful is doubtful
    assert told == (["fits"] if late is not None else [(77, 6)] * against)
    assert events.are_trusted == (False if late is not None else "asked")


def test_only_after_the_clock_was_set_is_it_learned_anew() -> None:
    events: Any = EventTimes(DistributedClock(OFFSET, LOOP_NS, READING_NS), RoundTrip(), 0)
    events._round_trip.least_ns, events.local_clock.excess_ns, clock = 50_000, 300.0, events.local_clock
    events.trust = SimpleNamespace(retry=lambda: None)
    for offset, loop_ns, path_ns in ((0, LOOP_NS, 48_300), (0, LOOP_NS + 400, 47_900), (1, LOOP_NS, 48_000)):
        events.retry(DistributedClock(OFFSET + offset, loop_ns, READING_NS))
        assert (events.path_delay_ns, events.local_clock is clock) == (path_ns, not offset)
