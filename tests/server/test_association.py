"""Which sample an exchange brought, what event times are worth, and what round trips tell: by tables."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace
from typing import Any

import pytest

from ethercat_server.sampling.association import (
    SILENT_PERIODS,
    Association,
    Expected,
    Read,
    associate_by_event,
    associate_by_polls,
    count_steps,
)
from ethercat_server.sampling.phase import SensorPhase
from ethercat_server.sampling.round_trip import RoundTrip
from ethercat_server.sampling.sample_clock import SampleClock
from ethercat_server.sampling.schedule import Schedule, best_margin_ns
from ethercat_server.sampling.trust import TRANSITIONS, Evidence, Trust, TrustState

PERIOD_NS, LEAST_NS = 1_000_000, 50_000
# The next sample is expected at 0; times below are in µs from then.


def brought(
    before: float, sent: float, took: float = 50, *, doubt: float = 20, is_doubtful: bool = False,
    has_events: bool = False, lost_track: bool = False, was_silent: bool = False,
) -> Association:  # fmt: skip
    expected = Expected(0.0, PERIOD_NS, doubt * 1e3, is_doubtful)
    read = Read(round(before * 1e3), round(sent * 1e3), round((sent + took) * 1e3), LEAST_NS)
    return associate_by_polls(
        expected, read, has_events=has_events, lost_track=lost_track, was_silent=was_silent
    )


@pytest.mark.parametrize(
    ("given", "number", "uncertain"),
    [
        pytest.param({"before": -900, "sent": 60}, 1, False, id="the next"),
        pytest.param({"before": -100, "sent": 60}, 1, False, id="the next, between two close reads"),
        pytest.param({"before": -900, "sent": 1060}, 2, False, id="one passed"),
        pytest.param({"before": -900, "sent": 4060}, 5, False, id="four passed"),
        pytest.param(
            {"before": -900, "sent": 990}, 1, True, id="this or the next: the phase is not so exact"
        ),
        pytest.param({"before": -900, "sent": 960, "took": 150}, 2, True, id="read before or after it came"),
        pytest.param(
            {"before": -900, "sent": 60, "took": 2050}, 1, True, id="held up after the read, or before"
        ),
        pytest.param({"before": -900, "sent": 960, "doubt": 100}, 1, True, id="the phase is hardly known"),
        pytest.param({"before": -900, "sent": 60, "is_doubtful": True}, 1, True, id="so was the one before"),
        pytest.param({"before": -1900, "sent": 60, "lost_track": True}, 1, True, id="without an event"),
        pytest.param({"before": -100, "sent": 60, "lost_track": True}, 1, False, id="only one can have come"),
        pytest.param({"before": -870, "sent": 60, "lost_track": True}, 1, False, id="within a period, too"),
        pytest.param({"before": -900, "sent": 60, "lost_track": True}, 1, True, id="not beyond one"),
        pytest.param({"before": -600, "sent": -550, "has_events": True}, 0, False, id="too early"),
        pytest.param({"before": 300, "sent": 800}, 2, False, id="nearer to the next but one"),
        pytest.param({"before": 300, "sent": 800, "has_events": True}, 1, False, id="which cannot be yet"),
        pytest.param({"before": 300, "sent": 800, "was_silent": True}, 2, True, id="is it? it was silent"),
        pytest.param(
            {"before": 300, "sent": 1030, "was_silent": True}, 2, False, id="it is, however silent it was"
        ),
        pytest.param({"before": -300, "sent": 60, "was_silent": True}, 1, False, id="the next, certainly"),
    ],
)
def test_which_sample_it_is_by_polls(given: dict[str, float], number: int, uncertain: bool) -> None:
    found = brought(**given)  # type: ignore[arg-type]
    assert (found.number, found.uncertain) == (number, uncertain)


@pytest.mark.parametrize(("late", "number"), [(0.0, 1), (0.4, 1), (-0.4, 1), (0.6, 2), (3.1, 4), (-0.9, 0)])
def test_which_sample_it_is_by_its_event(late: float, number: int) -> None:
    assert associate_by_event(late, uncertain=False).number == number


@pytest.mark.parametrize(
    ("number", "late", "is_doubtful", "absent", "unchanged", "expected"),
    [
        pytest.param(1, 0.0, False, 0, 1.0, (1, 1), id="the next"),
        pytest.param(3, 2.0, False, 0, 3.0, (3, 3), id="two lost"),
        pytest.param(0, -0.9, False, 0, 1.0, (1, 1), id="too early for the next: it is that"),
        pytest.param(0, -0.9, True, 0, 1.0, (0, 0), id="one too many was counted before"),
        pytest.param(1, 0.0, False, 2, 3.0, (1, 3), id="two were polled for and did not come"),
        pytest.param(1, -0.6, False, 1, 2.0, (1, 1), id="the one polled for came late"),
        pytest.param(1, 0.0, False, SILENT_PERIODS, 5.0, (1, 1), id="a silent sensor loses nothing"),
        pytest.param(1, 0.0, False, SILENT_PERIODS, 0.5, (1, 4), id="held up by the slave, not silent"),
    ],
)
def test_how_many_samples_passed(
    number: int, late: float, is_doubtful: bool, absent: int, unchanged: float, expected: tuple[int, int]
) -> None:
    found = Association(number, late, False)
    got = count_steps(found, is_doubtful=is_doubtful, absent=absent, unchanged_periods=unchanged)
    assert got == expected


@pytest.mark.parametrize(("state", "evidence"), [*itertools.product(TrustState, Evidence)])
def test_what_event_times_are_worth_changes_by_the_table_only(state: TrustState, evidence: Evidence) -> None:
    trust = Trust()
    trust.state = state
    if (state, evidence) in TRANSITIONS:
        trust._enter(evidence)
        assert trust.state is TRANSITIONS[state, evidence]
    else:
        with pytest.raises(KeyError):
            trust._enter(evidence)
        assert trust.state is state


MS, MINUTE = 10**6, 60 * 10**9


def tried(
    now_ns: int, count: int = 99, unfit: int = 1, difference_ns: float = 0.0, trust: Trust | None = None
) -> Trust:
    """After a trial that ends then, with so many events that fit, and that do not."""
    trust = trust or Trust()
    trust.judge(1.0, now_ns - 500 * MS, 0)
    for number in range(count + unfit):
        trust.compare(difference_ns if number < count else None, is_new=True, counts=True)
    trust.judge(1e6, now_ns, 0)
    return trust


@pytest.mark.parametrize(
    ("made", "state", "why"),
    [
        ({}, TrustState.TRUSTED, ""),
        ({"count": 98}, TrustState.TRIAL, ""),
        ({"count": 98, "unfit": 2}, TrustState.TRIAL, "they contradict the frames"),
        ({"difference_ns": 3000.0}, TrustState.TRUSTED, ""),
        (
            {"difference_ns": -3001.0},
            TrustState.TRIAL,
            "they differ from what polling shows by -3 µs",
        ),
    ],
)
def test_a_trial_is_of_so_many_events_that_fit_so_well(
    made: dict[str, Any], state: TrustState, why: str
) -> None:
    trust = tried(1000 * MS, **made)
    assert (trust.state, trust.why) == (state, why)


def test_a_trial_takes_its_time_and_needs_events_that_move() -> None:
    trust = Trust()
    for number in range(200):
        trust.compare(2.0, is_new=True, counts=True)
        found = trust.judge(1e6, 1000 * MS + number * 4 * MS, 0)
        assert bool(found) == trust.is_trusted == (number == 125), "the time before the first does not count"
        if found:
            assert found == 4.0
            break
    still = Trust()
    still.judge(1e6, 1, 0)
    for _ in range(100):
        still.compare(None, is_new=False, counts=True)
    assert still.judge(1e6, 500 * MS + 1, 4) == 0.0
    assert (still.state, still.why) == (TrustState.ABSENT, "they stand still")
    for restarts, state in ((4, TrustState.TRIAL), (5, TrustState.ABSENT)):
        jumps = Trust()
        jumps.judge(1e6, 1, 7)
        jumps.judge(1e6, 500 * MS + 1, 7 + restarts)
        assert jumps.state is state
    assert jumps.why == "its local clock does not run"


def test_contradictions_end_trust_and_each_trial_that_fails_doubles_the_pause() -> None:
    trust, now_ns = tried(1000 * MS), 1000 * MS
    for failure in range(1, 6):
        for number in range(5):
            assert trust.is_trusted
            assert trust.is_steady == (number == 0)
            trust.contradict(now_ns, 0)
        if failure < 5:
            tried(now_ns := now_ns + 1000 * MS, trust=trust)
    for pause_s in (10, 20, 40, 80, 160, 320, 320):
        assert (trust.state, trust.is_steady) == (TrustState.REFUSED, False)
        assert not trust.is_due(now_ns + pause_s * 1000 * MS - 1)
        now_ns += pause_s * 1000 * MS
        assert trust.is_due(now_ns)
        trust.retry()
        assert not trust.is_due(now_ns)
        tried(now_ns := now_ns + 1000 * MS, unfit=2, trust=trust)


@pytest.mark.parametrize(("trusted_ns", "failures"), [(MINUTE, 1), (MINUTE + 1, 5)])
def test_what_was_trusted_for_long_has_no_failures_behind_it(trusted_ns: int, failures: int) -> None:
    trust, now_ns = Trust(), 0
    for _ in range(4):
        tried(now_ns := now_ns + 1000 * MS, unfit=2, trust=trust)
    for _ in range(failures):
        assert trust.state is TrustState.TRIAL
        tried(now_ns := now_ns + 1000 * MS, trust=trust)
        now_ns += trusted_ns if not trust.contradictions else 0
        trusted_ns = 0
        for _ in range(5):
            trust.contradict(now_ns, 0)
    assert trust.state is TrustState.REFUSED


def test_a_contradiction_is_outweighed_by_a_hundred_samples() -> None:
    trust = tried(1000 * MS)
    for _ in range(4):
        trust.contradict(1000 * MS, 0)
    for _ in range(400):
        assert not trust.is_steady
        trust.confirm()
    trust.confirm()
    assert trust.is_steady
    for _ in range(100):
        trust.confirm()
    for _ in range(4):
        trust.contradict(1000 * MS, 0)
    assert trust.is_trusted, "more than none is no credit"
    trust.contradict(1000 * MS, 0)
    assert not trust.is_trusted


def test_what_round_trips_tell() -> None:
    bus = RoundTrip(10_000)
    assert bus.as_json() == {"least_us": None, "usual_us": None}
    bus.learn(0, 50_000, 60_000, 1000.0)
    assert bus.as_json() == {"least_us": 60.0, "usual_us": 79.7}
    assert (bus.excess_ns, bus.taking_over_ns, bus.late_ns) == (19_687.5, 156.25, 15.625)
    assert bus.patience_ns == 79_687.5 + 3 * 19_687.5 + 100_000
    assert bus.read_instant(100, 50_100) == (100, 0.0)
    assert bus.read_instant(100, 50_112) == (106.0, 12.0)
    stalled = RoundTrip()
    stalled.learn(0, 50_000, 50_000)
    before = stalled.excess_ns
    stalled.learn(10**6, 10**6 + 10**9, 2 * 10**9, 10.0**9)
    assert 0 < stalled.excess_ns - before < 2000, "a stall is no jitter"
    assert stalled.taking_over_ns == 20_000 / 64
    assert stalled.late_ns == 80_000 / 64


@pytest.mark.parametrize(
    ("first_us", "then_us", "moved_us"),
    [(50, 200, -10.0), (50, 55, 0.0), (200, 50, 75.0), (200, 181, 0.0), (200, 180, 10.0)],
)
def test_the_shortest_round_trip_is_a_recent_one(first_us: int, then_us: int, moved_us: float) -> None:
    """Where it changes by more than jitter all phases have another origin."""
    bus, window_ns = RoundTrip(), 2_000_000_000
    bus.learn_shortest(0, first_us * 1000)
    for number in range(1, 5):
        sent_ns = number * window_ns // 2
        bus.learn_shortest(sent_ns, sent_ns + then_us * 1000)
        is_known = then_us < first_us or number >= 4
        assert bus.least_ns == (then_us if is_known else first_us) * 1000
        assert bus.moved_ns == (moved_us * 1000 if is_known else 0.0)
    assert bus.excess_ns == 20_000 + 2 * bus.moved_ns


@pytest.mark.parametrize(
    ("cost", "deviation", "margin"), [(100, 10, 16.635), (25, 10, 0.0), (26, 10, 2.7045)]
)
def test_how_late_it_is_read_depends_on_what_an_early_poll_costs(
    cost: float, deviation: float, margin: float
) -> None:
    assert best_margin_ns(cost, deviation) == pytest.approx(margin, abs=1e-3)


def schedule(usual_us: float = 100, variance: float = 0.0) -> Schedule:
    """The next sample is expected at 5 ms, then one each ms."""
    phase: Any = SimpleNamespace(phase_ns=5e6, period_ns=1e6, variance=variance)
    bus: Any = SimpleNamespace(
        usual_ns=usual_us * 1e3, variance=1e8 - variance, read_variance=4e8, read_ns=3000.0, patience_ns=2e5
    )
    return Schedule(phase, bus)


@pytest.mark.parametrize(
    ("usual_us", "variance", "hits", "by_events", "margin", "aim_after", "probing"),
    [
        pytest.param(100, 0.0, 0, False, 16_635, 13_635, False, id="polled"),
        pytest.param(100, 0.0, 500, False, 16_635, 13_635, False, id="polled for long"),
        pytest.param(100, 0.0, 501, False, 16_635, 13_635, True, id="for too long"),
        pytest.param(100, 1.02e8, 0, False, 16_635, 13_635, False, id="known"),
        pytest.param(100, 1.03e8, 0, False, 16_635, 13_635, True, id="hardly known"),
        pytest.param(100, 1.03e8, 0, True, 18_548, 15_548, False, id="by events"),
        pytest.param(100, 0.0, 501, True, 18_548, -21_548, True, id="early on purpose"),
        pytest.param(500, 0.0, 0, True, 25_805, 22_805, False, id="time for two polls"),
        pytest.param(501, 0.0, 501, True, 34_609, 31_609, True, id="time for one"),
    ],
)
def test_how_long_after_a_sample_is_expected_it_is_polled_for(
    usual_us: float,
    variance: float,
    hits: int,
    by_events: bool,
    margin: float,
    aim_after: float,
    probing: bool,
) -> None:
    made = schedule(usual_us, variance)
    made.count_hit(hits)
    made.derive(by_events=by_events)
    assert (made.margin_ns, made.aim_after_ns) == pytest.approx((margin, aim_after), abs=1)
    assert (made.probing, made.single) == (probing, usual_us > 500)


def test_a_margin_shrinks_with_hits_and_grows_with_early_polls_of_samples_that_polls_date() -> None:
    made, found = schedule(), list[float]()
    for happens in (
        made.count_polled_hit, made.count_hit, made.count_polled_hit, lambda: made.count_early(adapts=False),
        made.count_polled_hit, made.count_hit, made.count_polled_hit, lambda: made.count_early(adapts=True),
        lambda: made.count_early(adapts=True),
    ):  # fmt: skip
        happens()
        made.derive(by_events=False)
        found.append(made.margin_ns / 16_635.1)
    once, twice = 1 - 0.11 / 16, (1 - 0.11 / 16) ** 2
    assert found == pytest.approx([1, 1, *[once] * 4, twice, 1, 1], abs=1e-5)


@pytest.mark.parametrize(
    ("usual_us", "hits", "sent_us", "asked", "next_us"),
    [
        pytest.param(100, 0, 4000, {"locked": False}, 4250, id="not followed"),
        pytest.param(100, 0, 5013, {}, 5013.635, id="before it is due"),
        pytest.param(100, 0, 5014, {}, 5014, id="early: again at once"),
        pytest.param(100, 0, 5014, {"overdue": True}, 5139, id="in steps"),
        pytest.param(100, 0, 5000, {"in_flight": True}, 5013.635, id="under way"),
        pytest.param(100, 0, 5100, {"in_flight": True, "unanswered": 2}, 5500, id="a frame was lost"),
        pytest.param(100, 0, 5100, {"in_flight": True, "unanswered": 9}, 6100, id="all are"),
        pytest.param(600, 0, 5000, {}, 5031.609, id="one poll each"),
        pytest.param(600, 0, 5014, {}, 5031.609, id="half a margin before the next"),
        pytest.param(600, 0, 5015, {}, 6031.609, id="that was for it"),
        pytest.param(600, 0, 7100, {"in_flight": True}, 8031.609, id="they are for those before"),
        pytest.param(600, 501, 4900, {}, 4997, id="early on purpose"),
        pytest.param(600, 501, 4979, {}, 4997, id="with time left for it"),
        pytest.param(600, 501, 4980, {}, 5031.609, id="without"),
    ],
)
def test_when_it_is_polled_next(
    usual_us: float, hits: int, sent_us: int, asked: dict[str, Any], next_us: float
) -> None:
    made = schedule(usual_us)
    made.count_hit(hits)
    made.derive(by_events=False)
    given: Any = {"unanswered": 0, "in_flight": False, "locked": True, "overdue": False} | asked
    assert made.next_poll_ns(sent_us * 1000, **given) == pytest.approx(next_us * 1e3, abs=1)


@pytest.mark.parametrize("late", [0.25, 2.25, -0.25, 1.75])
def test_where_polls_are_timed_by_polls_events_are_as_late_as_they_show(late: float) -> None:
    """Whichever sample it is."""
    events: Any = SimpleNamespace(
        are_trusted=True, variance=0.0, instant_ns=5e6, is_doubtful=False, date=lambda *_: late
    )
    clock = SampleClock(1e6, RoundTrip(), events)
    clock.phase.begin(3_999_000, 4_001_000)
    clock._begun = clock._schedule.single = True
    assert clock.observe(5_000_000, 5_900_000, None, fresh=True) is (round(late) == 0)
    assert (clock.steps, clock.instant_ns) == (1 + round(late), 5e6)
    assert clock._bias_ns == pytest.approx((late - round(late)) * 1e6 / 64)


def known_phase() -> SensorPhase:
    """Of a sensor that has been followed for long."""
    phase = SensorPhase(1e6)
    phase.begin(0.0, 1e5)
    for _ in range(50):
        phase.correct(0.0, 1e8)
        phase.advance(1)
    return phase


def test_four_contradictions_move_the_phase_and_leave_the_period() -> None:
    """As where the sensor has started anew."""
    phase = known_phase()
    begin_ns, period_ns, deviation = phase.phase_ns, phase.period_ns, math.sqrt(phase.period_variance)
    for number in range(4):
        assert phase.phase_ns == begin_ns
        assert math.sqrt(phase.variance) < 10_000
        phase.learn_instant(begin_ns + 300_000, 1e6)
        assert (phase.phase_ns == begin_ns) is (number < 3)
    assert (phase.phase_ns, phase.period_ns) == pytest.approx((begin_ns + 300_000, period_ns), abs=1e-3)
    assert phase.variance == pytest.approx(1e12 / 12, rel=1e-6)
    assert deviation < math.sqrt(phase.period_variance) == pytest.approx(2000.0, rel=1e-6)
    for most in (4000, 8000, 16_000, 30_000, 30_000):
        for _ in range(4):
            phase.variance = 1.0
            phase.learn_instant(phase.phase_ns + 300_000, 1.0)
        assert math.sqrt(phase.period_variance) == pytest.approx(most, rel=1e-6)
    phase.period_variance = 1e9
    for _ in range(4):
        phase.variance = 1.0
        phase.learn_instant(phase.phase_ns + 300_000, 1.0)
    assert phase.period_variance == 1e9, "what is known less already"


def test_a_contradiction_is_forgotten_with_the_next_that_fits() -> None:
    phase = known_phase()
    for _ in range(9):
        for _ in range(3):
            phase.learn_instant(phase.phase_ns + 300_000, 1e6)
        phase.learn_instant(phase.phase_ns, 1e6)
    assert phase.phase_ns == pytest.approx(known_phase().phase_ns)


def test_in_holdover_nothing_is_less_known_than_what_is_unknown() -> None:
    phase = known_phase()
    phase.advance(10**15)
    assert math.sqrt(phase.variance) == pytest.approx(1e6 / math.sqrt(12))
    assert math.sqrt(phase.period_variance) == pytest.approx(0.03e6)
    assert abs(phase._covariance) <= math.sqrt(phase.variance * phase.period_variance)
