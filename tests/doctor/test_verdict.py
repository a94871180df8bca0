"""What is made of the latencies that a server has measured."""

from __future__ import annotations

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor import bus_checks
from ethercat_server.doctor.finding import Finding


def summary(p99_us: float, p50_us: float = 20.0, max_us: float | None = None) -> dict[str, float]:
    return {"p50": p50_us, "p99": p99_us, "p999": p99_us, "max": max_us or p99_us}


def exchange(p99_us: float, lost: int = 0, p50_us: float = 80.0) -> Finding:
    return bus_checks.exchange_finding("", summary(p99_us, p50_us), lost, 2000)


def test_late_wake_ups_matter_by_what_they_cost() -> None:
    assert bus_checks.wake_finding(summary(20), 0, 1000).level is Level.GOOD
    assert bus_checks.wake_finding(summary(150), 0, 1000).level is Level.NOTE
    assert bus_checks.wake_finding(summary(400), 0, 1000).level is Level.LOOK
    one = bus_checks.wake_finding(summary(20, max_us=3000), 1, 2001)
    assert (one.level, one.values["later_than_a_period"]) == (Level.LOOK, 1)
    assert bus_checks.wake_finding(summary(20, max_us=3000), 10, 1000).level is Level.TROUBLE


def test_exchanges_matter_by_their_losses_and_their_time() -> None:
    assert exchange(80).level is Level.GOOD
    assert exchange(300).level is Level.NOTE
    assert exchange(80, lost=1).level is Level.LOOK
    assert exchange(80, lost=200).level is Level.TROUBLE
    slow = exchange(860, p50_us=860)
    assert slow.level is Level.LOOK
    assert "samples are 380 µs older than through a PCIe network card" in slow.why


def test_old_samples_are_judged_as_those_of_a_stream() -> None:
    for p99_us, level in (
        (900, Level.GOOD),
        (1300, Level.NOTE),
        (11_000, Level.LOOK),
        (110_000, Level.TROUBLE),
    ):
        assert bus_checks.age_finding("when sent", summary(p99_us), "").level is level


def test_scheduling_that_was_not_granted_is_said() -> None:
    assert next(bus_checks.scheduling(80, real_time=True)).level is Level.GOOD
    (refused,) = bus_checks.scheduling(80, real_time=False)
    assert (refused.level, "not granted" in refused.why) == (Level.NOTE, True)
    (wanted,) = bus_checks.scheduling(0, real_time=False)
    assert "as requested" in wanted.found
