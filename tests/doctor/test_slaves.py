"""What is said of slaves: models, states, where errors arise. No bus."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from bota_ethercat.health.verdict import Level
from ethercat_server.doctor import bus_checks
from ethercat_server.doctor.bus_checks import ErrorCounters, Slave
from ethercat_server.doctor.finding import Finding
from ethercat_server.ethercat.slave.al import AlStatus

INIT = AlStatus.of(1, 0)


def slave(**changes: Any) -> Slave:
    found: dict[str, Any] = {
        "position": 0, "al": INIT, "vendor": 0xB07A, "product": 1, "serial": 1234, "name": "BFT-SENS-ECAT-M8",
    }  # fmt: skip
    return Slave(**{**found, **changes})


def the(findings: Any) -> Finding:
    (finding,) = findings
    assert isinstance(finding, Finding)
    return finding


def test_whether_anything_answers() -> None:
    assert the(bus_checks.answers("ens5", 2)).level is Level.GOOD
    nothing = the(bus_checks.answers("ens5", 0))
    assert (nothing.level, nothing.values) == (Level.TROUBLE, {"slaves": 0})


@pytest.mark.parametrize(
    ("changes", "level", "named"),
    [
        ({}, Level.GOOD, "supported"),
        ({"name": "BFT-ROKS-ECAT-M8"}, Level.GOOD, "BFT-ROKS"),
        ({"vendor": 2, "name": "EK1100"}, Level.GOOD, "vendor 0x00000002, product 0x00000001: not a Bota"),
        ({"product": 9}, Level.GOOD, "product 0x00000009: not a Bota"),
        ({"name": "BFT-GENA"}, Level.TROUBLE, "BFT-GENA"),
        ({"name": "", "sii_problem": "the SII of slave 0 is busy"}, Level.LOOK, "busy"),
    ],
)
def test_who_it_is(changes: dict[str, Any], level: Level, named: str) -> None:
    found = the(bus_checks.identity(slave(**changes)))
    assert found.level is level
    assert named in found.found


def test_a_bus_without_a_sensor() -> None:
    coupler = slave(vendor=2, name="EK1100")
    assert the(bus_checks.any_sensor([coupler])).level is Level.TROUBLE
    assert not list(bus_checks.any_sensor([coupler, slave()]))
    assert not list(bus_checks.any_sensor([coupler, slave(vendor=0, sii_problem="busy")])), "it may be one"


@pytest.mark.parametrize(
    ("status", "code", "level"),
    [
        (1, 0, Level.GOOD),
        (8, 0, Level.GOOD),
        (0x14, 0x001B, Level.NOTE),
        (0x12, 0x0016, Level.LOOK),
        (3, 0, Level.TROUBLE),
        (0, 0, Level.TROUBLE),
    ],
)
def test_the_state_it_is_in(status: int, code: int, level: Level) -> None:
    found = the(bus_checks.al_state(slave(al=AlStatus.of(status, code))))
    assert found.level is level
    if code:
        assert f"0x{code:04X}" in found.found


def test_counters_are_taken_apart_by_port() -> None:
    registers = bytes([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 0, 0, 17, 18, 19, 20])
    found = ErrorCounters.parse(registers)
    assert found.invalid == (1, 3, 5, 7)
    assert found.physical == (2, 4, 6, 8)
    assert found.forwarded == (9, 10, 11, 12)
    assert (found.processing_unit, found.pdi) == (13, 14)
    assert found.lost_links == (17, 18, 19, 20)


def counted(**by_name: Any) -> ErrorCounters:
    return ErrorCounters(**by_name)


@pytest.mark.parametrize(
    ("position", "counters", "level", "said"),
    [
        (0, counted(), Level.GOOD, "none"),
        (0, counted(invalid=(3, 0, 0, 0)), Level.LOOK, "3 corrupted between the interface and slave 0"),
        (1, counted(physical=(4, 0, 0, 0)), Level.LOOK, "4 corrupted between slave 0 and slave 1"),
        (
            0,
            counted(invalid=(0, 255, 0, 0)),
            Level.LOOK,
            "255 or more corrupted between slave 0 and slave 1",
        ),
        (1, counted(invalid=(0, 1, 0, 0)), Level.LOOK, "1 corrupted at port 1 of slave 1"),
        (1, counted(forwarded=(2, 0, 0, 0)), Level.NOTE, "2 corrupted before reaching slave 1, port 0"),
        (
            0,
            counted(lost_links=(1, 0, 0, 0)),
            Level.NOTE,
            "link lost 1 times between the interface and slave 0",
        ),
        (0, counted(processing_unit=1), Level.NOTE, "processing unit 1, PDI 0"),
    ],
)
def test_where_errors_arise(position: int, counters: ErrorCounters, level: Level, said: str) -> None:
    found = the(bus_checks.error_counters(slave(position=position, counters=counters), 2))
    assert (found.level, found.found) == (level, said)


def test_only_what_is_new_counts_while_measuring() -> None:
    before = {0: counted(invalid=(5, 0, 0, 0)), 1: counted()}
    assert the(bus_checks.new_errors(before, before, 2)).level is Level.GOOD
    after = {0: counted(invalid=(6, 0, 0, 0)), 1: counted(forwarded=(1, 0, 0, 0))}
    found = the(bus_checks.new_errors(before, after, 2))
    assert found.level is Level.TROUBLE
    assert found.found.startswith("1 corrupted between the interface and slave 0; ")
    cleared = {0: counted(), 1: counted()}
    assert the(bus_checks.new_errors(before, cleared, 2)).level is Level.GOOD, (
        "a server was started meanwhile"
    )


def test_names_from_the_bus_are_told_in_json() -> None:
    found = the(bus_checks.identity(slave(al=AlStatus.parse(struct.pack("<HHH", 0x14, 0, 0x1B)))))
    assert found.values["al_state"] == "SAFEOP"
    assert found.values["al_error"] is True


def test_something_connected_that_does_not_answer() -> None:
    alone, linked = (True, False, False, False), (True, True, False, False)
    assert the(bus_checks.cabling([slave(links=alone)])).level is Level.GOOD
    assert the(bus_checks.cabling([slave(links=linked), slave(position=1, links=alone)])).level is Level.GOOD
    found = the(bus_checks.cabling([slave(links=linked), slave(position=1, links=linked)]))
    assert found.level is Level.NOTE
    assert found.found.endswith("port 0 of slave 1, port 1 of slave 1")
    assert list(bus_checks.cabling([])) == []
