"""Clock recovery against simulated sensors: own clock, late polls, stalls, lost frames, silence."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from ethercat_server.acquisition.timing.sample_clock import SampleClock

NOMINAL_NS = 1_250_000.0
SECOND = 1_000_000_000


@dataclass
class Run:
    """What a simulated run showed."""

    samples: int = 0
    polls: int = 0
    lost: int = 0
    counted_lost: int = 0
    locked_samples: int = 0
    first_locked_ns: float | None = None
    age_ns: list[float] = field(default_factory=list)
    stamp_error_ns: list[float] = field(default_factory=list)

    def median(self, values: list[float]) -> float:
        return sorted(values)[len(values) // 2]


def show(clock: SampleClock, sent_ns: int, received_ns: int, fresh: bool) -> None:
    """One valid exchange."""
    if fresh:
        clock.predict(sent_ns, received_ns)
    clock.observe(sent_ns, received_ns, fresh)


def simulate(
    ppm: float,
    *,
    seconds: float = 5,
    period_ns: float = NOMINAL_NS,
    stall_chance: float = 0.0,
    stall_in_exchange_chance: float = 0.0,
    frame_loss: float = 0.0,
    silent: Callable[[float], bool] = lambda _: False,
    seed: int = 1,
) -> tuple[Run, SampleClock]:
    """Drive a SampleClock as the loop does, with wake-up and exchange times of an ordinary kernel."""
    noise, other = random.Random(seed), random.Random(seed + 1)
    true_period = period_ns / (1 + ppm * 1e-6)
    phase = noise.random() * true_period + 1
    clock, run = SampleClock(period_ns), Run()
    now, shown = 1.0, -1
    while now < seconds * SECOND:
        due = clock.next_poll_ns() - 50_000
        sent = max(due, now) + noise.gammavariate(2, 20_000)
        if noise.random() < stall_chance:
            sent += noise.expovariate(1 / 3e6)
        evaluated = sent + noise.gammavariate(4, 6_000)
        received = evaluated + noise.gammavariate(4, 6_000)
        if other.random() < stall_in_exchange_chance:
            received += other.expovariate(1 / 20e6)
        now = received + 20_000
        run.polls += 1
        if noise.random() < frame_loss:
            continue
        newest = shown if silent(evaluated) else int((evaluated - phase) // true_period)
        fresh = newest != shown
        show(clock, int(sent), int(received), fresh)
        if not fresh:
            continue
        if shown >= 0:
            run.lost += newest - shown - 1
            run.counted_lost += clock.steps - 1
        shown = newest
        run.samples += 1
        if clock.locked:
            run.locked_samples += 1
            if run.first_locked_ns is None:
                run.first_locked_ns = now
            true_instant = phase + newest * true_period
            run.age_ns.append(received - true_instant)
            run.stamp_error_ns.append(clock.instant_ns - true_instant)
    return run, clock


@pytest.mark.parametrize("ppm", [0, 150, -300, 500, -500])
@pytest.mark.parametrize("period_ns", [1_250_000.0, 625_000.0])
def test_locks_and_loses_nothing(ppm: float, period_ns: float) -> None:
    run, clock = simulate(ppm, period_ns=period_ns)
    assert clock.locked
    assert run.first_locked_ns is not None
    assert run.first_locked_ns < SECOND
    assert run.lost == 0
    assert run.counted_lost == 0
    assert run.polls / run.samples < 2.1, "two exchanges a sample suffice"
    assert abs(run.median(run.stamp_error_ns)) < 10_000
    assert run.median(run.age_ns) < 100_000, "an eighth of the period at 800 Hz is 156 µs"


def test_learns_the_sensors_rate() -> None:
    _, clock = simulate(500, seconds=10)
    assert clock.period_ns == pytest.approx(NOMINAL_NS / 1.0005, rel=3e-4)


def test_holds_through_stalls_and_counts_exactly_what_they_cost() -> None:
    run, clock = simulate(150, seconds=20, stall_chance=0.002)
    assert run.lost > 0, "the stalls must be long enough to matter"
    assert run.counted_lost == run.lost
    assert clock.locked
    assert run.locked_samples > 0.98 * run.samples


def test_a_sample_fetched_before_a_stall_is_not_dated_into_it() -> None:
    run, clock = simulate(150, seconds=20, stall_in_exchange_chance=0.002)
    assert run.lost > 0, "the stalls must be long enough to matter"
    assert run.counted_lost == run.lost
    assert clock.locked
    assert max(run.stamp_error_ns) < 0.6 * NOMINAL_NS


def test_lost_frames_cost_no_lock() -> None:
    run, clock = simulate(-200, frame_loss=0.01)
    assert clock.locked
    assert run.counted_lost == run.lost
    assert run.lost <= 0.01 * run.samples


def test_goes_back_to_oversampling_when_the_sensor_falls_silent_and_locks_again() -> None:
    modes: list[bool] = []

    def silent(at_ns: float) -> bool:
        quiet = SECOND < at_ns < 2 * SECOND
        if quiet:
            modes.append(True)
        return quiet

    run, clock = simulate(100, seconds=4, silent=silent)
    assert modes
    assert clock.locked
    # What was watched and not seen did not exist: the silence counts as no loss.
    assert run.counted_lost <= 1


def test_does_not_follow_a_sensor_that_is_not_periodic() -> None:
    noise = random.Random(3)
    clock, now, change, shown, fresh_count = SampleClock(NOMINAL_NS), 0.0, 0.0, 0, 0
    newest = 0
    while now < 3 * SECOND:
        now = max(now, clock.next_poll_ns()) + 40_000
        while change < now:
            change += noise.uniform(0.1, 1.9) * NOMINAL_NS
            newest += 1
        fresh, shown = newest != shown, newest
        fresh_count += fresh
        show(clock, int(now), int(now) + 50_000, fresh)
    assert fresh_count > 1000
    assert not clock.locked
    assert clock.describe()["mode"] == "oversampling"


def test_restart_forgets_the_phase_but_not_the_rate() -> None:
    _, clock = simulate(400, seconds=8)
    learned = clock.period_ns
    clock.restart()
    assert not clock.locked
    assert clock.period_ns == learned


@pytest.mark.parametrize("sleep_more_ns", [60_000, 100_000])
def test_follows_a_simulated_sensor_that_sleeps_between_its_samples(sleep_more_ns: int) -> None:
    """Such a one is some percent slow and its phase walks at random: no loss may be claimed that was none."""
    noise = random.Random(5)
    clock, now, shown, newest, lost, claimed, seen = SampleClock(NOMINAL_NS), 1.0, 0, 0, 0, 0, 0
    change = NOMINAL_NS
    while now < 5 * SECOND:
        sent = max(clock.next_poll_ns() - 50_000, now) + noise.gammavariate(4, 8_000)
        evaluated = sent + noise.gammavariate(4, 10_000)
        received = evaluated + noise.gammavariate(4, 10_000)
        while change < evaluated:
            change += NOMINAL_NS + noise.gammavariate(4, sleep_more_ns / 4)
            newest += 1
        fresh = newest != shown
        show(clock, int(sent), int(received), fresh)
        if fresh and shown:
            lost += newest - shown - 1
            claimed += max(0, clock.steps - 1)
        seen += fresh
        shown, now = newest, received + 20_000
    assert seen > 3000
    assert lost == 0
    assert claimed <= 2, "while the rate is not yet known"
    assert clock.locked
    assert clock.pull == pytest.approx(sleep_more_ns / NOMINAL_NS, rel=0.1)
