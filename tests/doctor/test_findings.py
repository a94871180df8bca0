"""What is said of slaves (models, states, where errors arise) and of latencies. No bus."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import pytest

from bota_ethercat.health.limits import Level
from bota_ethercat.replies import DistributionStatus
from ethercat_server.doctor import bus_checks
from ethercat_server.doctor.bus_checks import ErrorCounters, Slave
from ethercat_server.doctor.report import Finding
from ethercat_server.ethercat.slave.al import AlStatus
from ethercat_server.sensor import scan

FINE, NOTE, LOOK, BAD = Level.GOOD, Level.NOTE, Level.LOOK, Level.TROUBLE
USUAL: dict[str, Any] = {"position": 0, "al": AlStatus.of(1, 0), "sii_problem": ""}
PORTS = {
    "invalid": slice(0, 8, 2), "physical": slice(1, 8, 2), "forwarded": slice(8, 12),
    "processing_unit": slice(12, 13), "lost_links": slice(16, 20),
}  # fmt: skip


def slave(**changes: Any) -> Slave:
    who = {"vendor": 0xB07A, "product": 1, "serial": 1234, "name": "BFT-SENS-ECAT-M8"}
    who |= {key: changes.pop(key) for key in who if key in changes}
    position, al, problem = (changes.pop(key, usual) for key, usual in USUAL.items())
    sii = None if problem else cast("Any", who)
    return Slave(scan.Slave(position, al, sii, problem), **changes)


def counted(**by_name: tuple[int, ...]) -> bytes:
    """The registers with these counts."""
    data = bytearray(20)
    for name, value in by_name.items():
        data[PORTS[name]] = bytes(value)
    return bytes(data)


def test_whether_anything_answers() -> None:
    assert bus_checks.answers("ens5", 2).level is FINE
    nothing = bus_checks.answers("ens5", 0)
    assert (nothing.level, nothing.values) == (BAD, {"slaves": 0})


@pytest.mark.parametrize(
    ("changes", "level", "named"),
    [
        ({}, FINE, "supported"),
        ({"vendor": 2, "name": "EK1100"}, FINE, "vendor 0x00000002, product 0x00000001: not a Bota"),
        ({"product": 9}, FINE, "product 0x00000009: not a Bota"),
        ({"name": "BFT-GENA"}, BAD, "BFT-GENA"),
        ({"sii_problem": "the SII of slave 0 is busy"}, LOOK, "busy"),
    ],
)
def test_who_it_is(changes: dict[str, Any], level: Level, named: str) -> None:
    found = bus_checks.identity(slave(al=AlStatus.of(0x14, 0x1B), **changes))
    assert (found.level, named in found.found) == (level, True)
    assert (found.values["al_state"], found.values["al_error"]) == ("SAFEOP", True)


COUPLER, BUSY = slave(vendor=2, name="EK1100"), slave(sii_problem="busy")


@pytest.mark.parametrize(
    ("found", "level", "said"),
    [
        (bus_checks.any_sensor([COUPLER]), BAD, "no Bota Gen-0 sensor"),
        (bus_checks.any_sensor([COUPLER, slave()]), None, ""),
        (bus_checks.any_sensor([COUPLER, BUSY]), None, ""),  # it may be one
    ],
)  # fmt: skip
def test_a_bus_as_a_whole(found: Iterable[Finding], level: Level | None, said: str) -> None:
    assert [(each.level, said in each.found) for each in found] == ([] if level is None else [(level, True)])


@pytest.mark.parametrize(
    ("status", "code", "level"),
    [(1, 0, FINE), (8, 0, FINE), (0x14, 0x001B, NOTE), (0x12, 0x0016, LOOK), (3, 0, BAD), (0, 0, BAD)],
)
def test_the_state_it_is_in(status: int, code: int, level: Level) -> None:
    found = bus_checks.al_state(slave(al=AlStatus.of(status, code)))
    assert found.level is level
    assert f"0x{code:04X}" in found.found or not code


def test_counters_are_taken_apart_by_port() -> None:
    registers = bytes([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 0, 0, 17, 18, 19, 20])
    ports = (1, 3, 5, 7), (2, 4, 6, 8), (9, 10, 11, 12)
    assert ErrorCounters.parse(registers) == (*ports, 13, 14, (17, 18, 19, 20))


@pytest.mark.parametrize(
    ("position", "counters", "level", "said"),
    [
        (0, counted(), FINE, "none"),
        (0, counted(invalid=(3, 0, 0, 0)), LOOK, "3 corrupted between the interface and slave 0"),
        (1, counted(physical=(4, 0, 0, 0)), LOOK, "4 corrupted between slave 0 and slave 1"),
        (0, counted(invalid=(0, 255, 0, 0)), LOOK, "255 or more corrupted between slave 0 and slave 1"),
        (1, counted(invalid=(0, 1, 0, 0)), LOOK, "1 corrupted at port 1 of slave 1"),
        (1, counted(forwarded=(2, 0, 0, 0)), NOTE, "2 corrupted before reaching slave 1, port 0"),
        (0, counted(lost_links=(1, 0, 0, 0)), NOTE, "link lost 1 times between the interface and slave 0"),
        (0, counted(processing_unit=(1,)), NOTE, "processing unit 1, PDI 0"),
    ],
)
def test_where_errors_arise(position: int, counters: bytes, level: Level, said: str) -> None:
    found = bus_checks.error_counters(slave(position=position, errors=counters), 2)
    assert (found.level, found.found) == (level, said)


def test_only_what_is_new_counts_while_measuring() -> None:
    before = {0: counted(invalid=(5, 0, 0, 0)), 1: counted()}
    assert bus_checks.new_errors(before, before, 2).level is FINE
    after = {0: counted(invalid=(6, 0, 0, 0)), 1: counted(forwarded=(1, 0, 0, 0))}
    found = bus_checks.new_errors(before, after, 2)
    assert found.level is BAD
    assert found.found.startswith("1 corrupted between the interface and slave 0; ")
    cleared = bus_checks.new_errors(before, {0: counted(), 1: counted()}, 2)
    assert cleared.level is FINE, "a server was started meanwhile"


# -- latencies that a server has measured


def summary(p99_us: float, p50_us: float = 20.0, max_us: float | None = None) -> DistributionStatus:
    return DistributionStatus(p50_us, p99_us, p99_us, max_us or p99_us)


@pytest.mark.parametrize(
    ("p99_us", "late", "count", "level"),
    [
        (20, 0, 1000, FINE),
        (150, 0, 1000, NOTE),
        (400, 0, 1000, LOOK),
        (20, 1, 2001, LOOK),
    ],
)
def test_late_wake_ups_matter_by_what_they_cost(p99_us: float, late: int, count: int, level: Level) -> None:
    found = bus_checks.wake_finding(summary(p99_us), late, count)
    assert (found.level, found.values["later_than_a_period"]) == (level, late)


@pytest.mark.parametrize(
    ("p50_us", "p99_us", "lost", "level"),
    [(80, 80, 0, FINE), (80, 300, 0, NOTE), (80, 80, 1, LOOK), (860, 860, 0, LOOK)],
)
def test_exchanges_matter_by_losses_and_time(p50_us: float, p99_us: float, lost: int, level: Level) -> None:
    found = bus_checks.exchange_finding("", summary(p99_us, p50_us), lost, 2000)
    assert found.level is level
    if p50_us == 860:
        assert "samples are 380 µs older than through a PCIe network card" in found.why


@pytest.mark.parametrize(("p99_us", "level"), [(900, FINE), (1300, NOTE), (11_000, LOOK), (110_000, BAD)])
def test_old_samples_are_judged_as_those_of_a_stream(p99_us: float, level: Level) -> None:
    assert bus_checks.age_finding("when sent", summary(p99_us)).level is level


@pytest.mark.parametrize(
    ("priority", "real_time", "level", "said"),
    [(80, True, FINE, "SCHED_FIFO 80"), (80, False, NOTE, "not granted"), (0, False, NOTE, "as requested")],
)
def test_scheduling_that_was_not_granted_is_said(
    priority: int, real_time: bool, level: Level, said: str
) -> None:
    found = bus_checks.scheduling(priority, real_time=real_time)
    assert (found.level, said in found.found + found.why) == (level, True)
