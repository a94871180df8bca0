"""What is made of a measurement, and the measurement itself without a bus."""

from __future__ import annotations

import os
import time

import pytest

from ethercat_server.doctor import verdict
from ethercat_server.doctor.bus.measurement import PERIOD_NS, Measured, measure
from ethercat_server.doctor.finding import CannotLookError, Finding, Level


def of(late_us: list[int], exchanges_us: list[int] | None = None, message_us: int = 40) -> Measured:
    return Measured(
        late=[n * 1000 for n in late_us],
        exchanges=[n * 1000 if n >= 0 else -1 for n in exchanges_us or []],
        messages=dict.fromkeys(range(len(late_us)), message_us * 1000),
        real_time=True,
        priority=80,
    )


def wake(late_us: list[int]) -> Finding:
    (found,) = verdict.wake_ups(of(late_us))
    return found


def exchange(exchanges_us: list[int]) -> Finding:
    (found,) = verdict.exchanges(of([0] * len(exchanges_us), exchanges_us), 62)
    return found


def test_late_wake_ups_matter_by_what_they_cost() -> None:
    assert wake([20] * 1000).level is Level.OK
    assert wake([20] * 900 + [150] * 100).level is Level.NOTE
    assert wake([20] * 900 + [400] * 100).level is Level.WARNING
    one = wake([20] * 2000 + [3000])
    assert (one.level, one.values["later_than_a_period"]) == (Level.WARNING, 1)
    assert wake([20] * 990 + [3000] * 10).level is Level.BAD
    with pytest.raises(CannotLookError):
        wake([])


def test_without_the_scheduling_of_a_server_nothing_measured_is_trouble() -> None:
    measured = of([20] * 990 + [3000] * 10, message_us=3000)
    for real_time in (True, False):
        measured.real_time = real_time
        levels = [finding.level for finding in (*verdict.wake_ups(measured), *verdict.messages(measured))]
        assert (max(levels) is Level.BAD) is real_time
        assert real_time or max(levels) is Level.NOTE


def test_exchanges_matter_by_their_losses_and_their_time() -> None:
    assert exchange([80] * 1000).level is Level.OK
    assert exchange([80] * 900 + [300] * 100).level is Level.NOTE
    assert exchange([80] * 2000 + [-1]).level is Level.WARNING
    assert exchange([80] * 900 + [-1] * 100).level is Level.BAD
    slow = exchange([860] * 1000)
    assert slow.level is Level.WARNING
    assert "samples are 380 µs older than through a PCIe network card" in slow.why
    none = exchange([-1] * 5)
    assert (none.level, none.values["lost"]) == (Level.BAD, 5)


def test_the_age_follows_the_formula() -> None:
    steady = of([30] * 100, [100] * 100, message_us=40)
    margin = steady.margin_ns()
    assert 0 < margin < 100_000
    expected = margin + 50_000
    assert steady.ages() == ([expected] * 100, [expected + 40_000] * 100), (
        "aim, half an exchange; the message"
    )
    late = of([30] * 99 + [130], [100] * 100, message_us=40)
    assert late.ages()[0][-1] == pytest.approx(late.margin_ns() + 50_000 + 100_000)
    early = of([30] * 99 + [0], [100] * 100, message_us=40)
    assert early.ages()[0][-1] == 50_000 + max(0, early.margin_ns() - 30_000), (
        "too early to see it: another exchange follows at once, none is younger"
    )
    slow = of([30] * 99 + [30], [100] * 99 + [300], message_us=40)
    assert slow.ages()[0][-1] == pytest.approx(slow.margin_ns() + (300_000 - 102_000) / 2 + 150_000)
    assert len(of([30] * 3, [100, -1, 100]).ages()[0]) == 2, "a lost frame brings nothing"


def test_no_age_without_bus_or_messages() -> None:
    (none,) = verdict.age(of([30] * 3))
    assert none.level is Level.SKIPPED
    assert len(list(verdict.age(Measured(late=[1], exchanges=[1])))) == 1, "no client"
    handed_out, arrived = verdict.age(of([0] * 100, [100] * 100, message_us=2000))
    assert (handed_out.level, arrived.level) == (Level.OK, Level.NOTE)
    assert "age = max(0, margin" in handed_out.why


def test_scheduling_that_was_not_granted_is_said() -> None:
    assert next(verdict.scheduling(of([1]))).level is Level.OK
    (refused,) = verdict.scheduling(Measured(priority=80))
    assert (refused.level, "not granted" in refused.why) == (Level.NOTE, True)
    (wanted,) = verdict.scheduling(Measured(priority=0))
    assert "as requested" in wanted.found


def test_messages_that_did_not_come_through() -> None:
    assert next(verdict.messages(of([1] * 10))).level is Level.OK
    missing = of([1] * 10)
    del missing.messages[3]
    (found,) = verdict.messages(missing)
    assert (found.level, found.values["missing"]) == (Level.NOTE, 1)
    with pytest.raises(CannotLookError):
        list(verdict.messages(Measured(late=[1])))
    for late_us, level in ((900, Level.NOTE), (11_000, Level.WARNING), (110_000, Level.BAD)):
        assert next(verdict.messages(of([1] * 10, message_us=late_us))).level is level, "as of old samples"


def test_measuring_leaves_the_process_as_it_was() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    calls: list[int] = []

    def slow_every_tenth() -> bool:
        calls.append(1)
        if len(calls) % 10 == 1:
            time.sleep(2 * PERIOD_NS * 1e-9)
        return len(calls) % 7 != 0

    found = measure(0.2, slow_every_tenth, 0, None)
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before
    assert not found.real_time
    assert len(found.late) == len(found.exchanges) <= 0.2e9 / PERIOD_NS + 1
    assert set(found.messages) <= set(range(len(found.late)))
    assert found.messages
    assert found.lost in range(len(found.late) // 7 - 1, len(found.late) // 7 + 2)
    assert max(found.exchanges) >= 2 * PERIOD_NS
    assert all(late >= 0 for late in found.late), "the deadlines that passed meanwhile are left out"


def test_an_interrupted_measurement_restores_everything_too() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)

    def stopped() -> bool:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure(5, stopped, 1, min(os.sched_getaffinity(0)))
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before
