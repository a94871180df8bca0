"""Samples dated by a slave controller's event times, and every way in which these can be wrong.

All in simulated time: the machine, the network card, the sensor, the controller's clock.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from ethercat_server.acquisition.slave_clock import Verdict
from tests.clock_simulation import Card, ClockSimulation, Controller, Machine, Outcome, Sensor
from tests.simulation import more_if_long

QUIET, CARD = Machine(), Card()
SENSOR = Sensor(400.0, ppm=150.0)
HONEST = Controller()
LIES_FROM_S = 3.0


def run(
    controller: Controller | None,
    sensor: Sensor = SENSOR,
    card: Card = CARD,
    machine: Machine = QUIET,
    seconds: float = 6.0,
    seed: int = 1,
) -> ClockSimulation:
    return ClockSimulation(sensor, card, machine, seed, controller).run(seconds)


def verdict(simulation: ClockSimulation) -> Verdict:
    assert simulation.clock.events is not None
    return simulation.clock.events.trust.verdict


def why(simulation: ClockSimulation) -> str:
    assert simulation.clock.events is not None
    return simulation.clock.events.trust.why


def percentile(values: list[float], percent: float) -> float:
    return values[int(len(values) * percent / 100)]


def assert_right(outcome: Outcome) -> None:
    assert percentile(outcome.errors_ns, 50) < 3e3
    assert percentile(outcome.errors_ns, 99) < 10e3
    assert outcome.lost == outcome.counted
    assert outcome.unflagged == 0
    assert outcome.outside == 0


@pytest.mark.parametrize(("rate_hz", "seconds"), [(1600.0, 3.0), (150.0, 12.0), (25.0, 40.0)])
def test_events_date_samples_with_one_exchange_each(rate_hz: float, seconds: float) -> None:
    runs = [run(HONEST, Sensor(rate_hz, ppm=-300.0), seconds=seconds, seed=seed) for seed in range(1, 4)]
    assert {verdict(simulation) for simulation in runs} == {Verdict.TRUSTED}
    outcomes = [simulation.outcome(seconds / 2) for simulation in runs]
    outcome = Outcome(
        [sample for each in outcomes for sample in each.samples], sum(each.polls for each in outcomes)
    )
    assert percentile(outcome.errors_ns, 50) < 3e3
    assert percentile(outcome.errors_ns, 99) < 10e3
    assert (
        sum(each.lost + each.counted + each.unflagged + each.outside + each.unlocked for each in outcomes)
        == 0
    )
    assert outcome.exchanges < 1.05
    by_polling = run(None, Sensor(rate_hz, ppm=-300.0), seconds=seconds).outcome(seconds / 2)
    assert outcome.exchanges < by_polling.exchanges - 0.05
    assert percentile(outcome.ages_ns, 99) < percentile(by_polling.ages_ns, 99)


@pytest.mark.parametrize(
    ("card", "machine"),
    [
        pytest.param(Card(2e6, spread=0, jitter_ns=4e5), QUIET, id="slow card"),
        pytest.param(Card(lost=0.01), QUIET, id="lost frames"),
        pytest.param(Card(), Machine(stolen=0.2), id="stolen time"),
        pytest.param(Card(), Machine(stops=((3.5, 3e8), (4.5, 2e7), (5.0, 7e8))), id="stops"),
    ],
)
def test_events_date_samples_where_polling_hardly_can(card: Card, machine: Machine) -> None:
    simulation = run(HONEST, card=card, machine=machine)
    assert verdict(simulation) is Verdict.TRUSTED
    assert_right(simulation.outcome(3.0))


@pytest.mark.parametrize(
    "sensor",
    [
        pytest.param(replace(SENSOR, white_ns=2e4), id="jitter"),
        pytest.param(replace(SENSOR, restart_s=4.5), id="restart"),
        pytest.param(replace(SENSOR, silent_s=(3.5, 4.5)), id="silence"),
    ],
)
def test_events_follow_a_sensor_that_is_no_good_clock(sensor: Sensor) -> None:
    simulation = run(HONEST, sensor)
    assert verdict(simulation) is Verdict.TRUSTED
    outcome = simulation.outcome(3.0)
    assert percentile(outcome.errors_ns, 50) < 3e3
    assert percentile(outcome.errors_ns, 99) < 10e3


WRONG = {
    "late": Controller(late_ns=100e3),
    "late within the margin": Controller(late_ns=40e3),
    "start of the buffer": Controller(late_ns=-100e3),
    "start of a short buffer": Controller(late_ns=-12e3),
    "of the sample before": Controller(lags=1),
    "at random": Controller(jitter_ns=50e3),
    "stands still": Controller(stuck=True),
    "time stands still": Controller(stops=True),
    "time runs wrong": Controller(step_ppm=-5000.0),
}
REASONS = {
    "stands still": "they stand still",
    "time stands still": "",  # the clock does not run, or event times stand still
    "time runs wrong": "its local clock does not run",
}


EVERY_WRONG = [(name, since_s) for name in WRONG for since_s in (0.0, LIES_FROM_S)]


@pytest.mark.parametrize("wrong", more_if_long(EVERY_WRONG[1::4] + EVERY_WRONG[2::4], EVERY_WRONG), ids=str)
def test_wrong_event_times_are_refused_and_polling_goes_on(wrong: tuple[str, float]) -> None:
    name, since_s = wrong
    simulation = run(replace(WRONG[name], lies_from_s=since_s), seconds=8.0)
    assert verdict(simulation) is Verdict.REFUSED
    assert REASONS.get(name, "they ") in why(simulation)
    outcome = simulation.outcome(1.0)
    assert outcome.lost == outcome.counted == outcome.unflagged == 0
    # Those until it is noticed: an early event that fits between two polls is dated by it.
    assert outcome.outside < 100
    after = simulation.outcome(6.0)
    assert after.outside == after.unlocked == 0
    assert percentile(after.errors_ns, 99) < 20e3


@pytest.mark.parametrize("late_ns", [-200e3, -100e3, 100e3, 200e3])
@pytest.mark.parametrize("since_s", [0.0, LIES_FROM_S])
def test_no_lie_costs_a_sample_on_a_slow_card(late_ns: float, since_s: float) -> None:
    """Of a long round trip so much may be on one side, so such event times are believed."""
    for rate_hz, jitter_ns in ((800.0, 5e4), (800.0, 4e5), (1600.0, 5e4), (1600.0, 4e5)):
        lying = Controller(late_ns=late_ns, lies_from_s=since_s)
        card = Card(2.2e6, spread=0, jitter_ns=jitter_ns)
        simulation = run(lying, Sensor(rate_hz, ppm=150.0), card, seconds=5.0)
        outcome = simulation.outcome(1.0)
        assert (outcome.lost, outcome.counted, outcome.unflagged, outcome.unlocked) == (0, 0, 0, 0)
        assert outcome.outside == 0
        assert outcome.exchanges < 1.05


@pytest.mark.parametrize(
    "controller",
    [
        Controller(jitter_ns=10e3),
        Controller(jitter_ns=20e3),
        Controller(late_ns=18e3, lies_from_s=LIES_FROM_S),
    ],
    ids=["10 µs", "20 µs", "late within the frame"],
)
def test_event_times_that_are_worse_than_polling_are_not_used(controller: Controller) -> None:
    simulation = run(controller, seconds=12.0)
    assert verdict(simulation) is Verdict.REFUSED
    outcome = simulation.outcome(4.0)
    assert percentile(outcome.errors_ns, 99) < 12e3
    by_polling = run(None, seconds=12.0).outcome(4.0)
    assert percentile(outcome.errors_ns, 99) < percentile(by_polling.errors_ns, 99) + 3e3


def test_event_times_are_trusted_again_once_they_are_right() -> None:
    lying = Controller(jitter_ns=50e3, lies_from_s=LIES_FROM_S, lies_until_s=9.0)
    simulation = run(lying, seconds=9.0)
    assert verdict(simulation) is Verdict.REFUSED
    simulation.run(17.0)
    assert verdict(simulation) is Verdict.TRUSTED
    assert_right(simulation.outcome(16.5))


def test_pauses_between_trials_double_until_event_times_have_proved_right_for_long() -> None:
    """So those that are hardly right do not switch stamps on and off."""
    simulation, lying = run(HONEST, Sensor(150.0), seconds=3.0), Controller(jitter_ns=50e3)

    def run_until(wanted: Verdict) -> float:
        since_s = simulation.now_ns / 1e9
        while verdict(simulation) is not wanted:
            simulation.run(simulation.now_ns / 1e9 + 0.1)
        return simulation.now_ns / 1e9 - since_s

    def pause_s() -> float:
        run_until(Verdict.REFUSED)
        return run_until(Verdict.TRIAL)

    simulation.controller = lying
    assert [pause_s() for _ in range(3)] == pytest.approx([10, 20, 40], abs=0.5)
    simulation.controller = HONEST
    run_until(Verdict.TRUSTED)
    simulation.run(simulation.now_ns / 1e9 + 61.0)
    simulation.controller = lying
    assert pause_s() == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize("seconds", [0.8, 3.0], ids=["on trial", "trusted"])
def test_what_does_not_fit_while_the_machine_is_busy_is_not_held_against_event_times(seconds: float) -> None:
    """An exchange was away for long then: who knows what has held up what."""
    for took_ns, counts in ((20e6, False), (100e3, True)):
        simulation = run(HONEST, seconds=seconds)
        events = simulation.clock.events
        assert events is not None
        for number in range(300):
            sent = int(simulation.now_ns + number * 30e6)
            back = sent + int(took_ns)
            long_ago = HONEST.local(sent - 1e9)
            events.take((HONEST.local(sent), 1, long_ago, 1), sent, back, True, simulation.clock.period_ns)
            if events.are_trusted:
                events.date(sent, simulation.clock.period_ns, 1e6, sent, back)
            else:
                events.compare(0.0, 1e6, back)
        assert bool(why(simulation)) is counts


def test_registers_that_nobody_has_are_refused_within_a_second() -> None:
    for controller in (Controller(counter=0), Controller(stuck=True)):
        assert verdict(run(controller, seconds=1.0)) is Verdict.REFUSED


@pytest.mark.parametrize("jump_ns", [3e6, 30e3, -30e3, -1e9])
def test_a_clock_that_jumps_is_not_believed_until_it_has_proved_right_again(jump_ns: float) -> None:
    simulation = run(Controller(jump_ns=jump_ns, lies_from_s=LIES_FROM_S), seconds=9.0)
    outcome = simulation.outcome(1.0)
    assert outcome.outside == outcome.lost == outcome.counted == 0
    assert verdict(simulation) is Verdict.TRUSTED
    assert percentile(simulation.outcome(8.0).errors_ns, 99) < 10e3


def test_a_change_of_the_clocks_rate_is_followed() -> None:
    simulation = run(Controller(step_ppm=50.0, lies_from_s=LIES_FROM_S), seconds=8.0)
    assert verdict(simulation) is Verdict.TRUSTED
    assert simulation.outcome(1.0).outside == 0
    assert percentile(simulation.outcome(7.0).errors_ns, 99) < 10e3


@pytest.mark.parametrize("controller", [None, HONEST], ids=["polling", "events"])
@pytest.mark.parametrize("excess_ns", [0.0, 30e3])
@pytest.mark.parametrize("outward", [0.0, 0.5, 1.0])
def test_the_uncertainty_covers_an_excess_on_one_side(
    controller: Controller | None, excess_ns: float, outward: float
) -> None:
    """Which side cannot be told; the shortest round trip is a rare one."""
    card = Card(16e3, spread=0, jitter_ns=2e3, excess_ns=excess_ns, outward=outward)
    told = []
    for seed in range(1, 5):
        simulation = run(controller, card=card, seconds=8.0, seed=seed)
        outcome = simulation.outcome(3.0)
        assert simulation.clock.by_events is bool(controller)
        assert outcome.outside == 0
        told.append(percentile(sorted(sample.uncertainty_ns for sample in outcome.samples), 99))
    assert min(told) < (16e3 + excess_ns) / 2 + 12e3, "where short ones are seen"


def test_the_uncertainty_covers_the_stamps_of_a_lopsided_round_trip() -> None:
    simulation = run(Controller(late_ns=-4e3))
    assert simulation.outcome(1.0).outside == 0
