"""What is said of slaves (models, states, where errors arise) and of latencies. No bus."""

from __future__ import annotations

from typing import Any, cast

import pytest

from bota_ethercat.health.limits import Level
from bota_ethercat.replies import DistributionStatus
from ethercat_server.doctor import bus_checks
from ethercat_server.doctor.bus_checks import ExaminedSlave
from ethercat_server.doctor.report import CheckResult
from ethercat_server.ethercat.slave.al import AlStatus
from ethercat_server.sensor import scan

FINE, NOTE, LOOK, BAD = Level.GOOD, Level.NOTE, Level.LOOK, Level.TROUBLE
USUAL: dict[str, Any] = {"position": 0, "al": AlStatus.of(1, 0), "sii_problem": ""}
PORTS = {
    "invalid": slice(0, 8, 2), "physical": slice(1, 8, 2), "forwarded": slice(8, 12),
    "processing_unit": slice(12, 13), "pdi": slice(13, 14), "lost_links": slice(16, 20),
}  # fmt: skip


def slave(**changes: Any) -> ExaminedSlave:
    who = {"vendor": 0xB07A, "product": 1, "serial": 1234, "name": "BFT-SENS-ECAT-M8"}
    who |= {key: changes.pop(key) for key in who if key in changes}
    position, al, problem = (changes.pop(key, usual) for key, usual in USUAL.items())
    sii = None if problem else cast("Any", who)
    return ExaminedSlave(scan.Slave(position, al, sii, problem), **changes)


def counted(**by_name: tuple[int, ...]) -> bytes:
    """The registers with these counts."""
    data = bytearray(20)
    for name, value in by_name.items():
        data[PORTS[name]] = bytes(value)
    return bytes(data)


def who(**changes: Any) -> CheckResult:
    found = bus_checks.identity(slave(al=AlStatus.of(0x14, 0x1B), **changes))
    assert (found.values["al_state"], found.values["al_error"]) == ("SAFEOP", True)
    return found


def state(status: int, code: int) -> CheckResult:
    return bus_checks.al_state(slave(al=AlStatus.of(status, code)))


def errors(position: int, **by_name: tuple[int, ...]) -> CheckResult:
    """Of one of two slaves."""
    return bus_checks.error_counters(slave(position=position, errors=counted(**by_name)), 2)


def grown(*after: bytes) -> CheckResult:
    """What came up while measuring two slaves, the first of which had five errors before."""
    before = {0: counted(invalid=(5, 0, 0, 0)), 1: counted()}
    return bus_checks.new_errors(before, dict(enumerate(after)), 2)


def summary(p99_us: float, p50_us: float = 20.0) -> DistributionStatus:
    return DistributionStatus(p50_us, p99_us, p99_us, p99_us)


def late(p99_us: float, count: int = 0) -> CheckResult:
    found = bus_checks.wake_finding(summary(p99_us), count, 2001)
    assert found.values["later_than_a_period"] == count
    return found


def exchanges(p50_us: float, p99_us: float, lost: int = 0) -> CheckResult:
    return bus_checks.exchange_finding("", summary(p99_us, p50_us), lost, 2000)


@pytest.mark.parametrize(
    ("found", "level", "said"),
    [
        (bus_checks.answers("ens5", 2), FINE, "2 slaves answer"),
        (bus_checks.answers("ens5", 0), BAD, "no EtherCAT slave answers"),
        (who(), FINE, "supported"),
        (who(vendor=2, name="EK1100"), FINE, "vendor 0x00000002, product 0x00000001: not a Bota"),
        (who(product=9), FINE, "product 0x00000009: not a Bota"),
        (who(name="BFT-GENA"), BAD, "BFT-GENA"),
        (who(sii_problem="the SII of slave 0 is busy"), LOOK, "busy"),
        (state(1, 0), FINE, "INIT"),
        (state(8, 0), FINE, "OP"),
        (state(0x14, 0x001B), NOTE, "0x001B"),
        (state(0x12, 0x0016), LOOK, "0x0016"),
        (state(3, 0), BAD, "BOOT"),
        (state(0, 0), BAD, ""),
        (errors(0), FINE, "none"),
        (errors(0, invalid=(3, 0, 0, 0)), LOOK, "3 corrupted between the interface and slave 0"),
        (errors(1, physical=(4, 0, 0, 0)), LOOK, "4 corrupted between slave 0 and slave 1"),
        (errors(0, invalid=(0, 255, 0, 0)), LOOK, "255 or more corrupted between slave 0 and slave 1"),
        (errors(1, invalid=(0, 1, 0, 0)), LOOK, "1 corrupted at port 1 of slave 1"),
        (errors(1, forwarded=(2, 0, 0, 0)), NOTE, "2 corrupted before reaching slave 1, port 0"),
        (errors(0, lost_links=(1, 0, 0, 0)), NOTE, "link lost 1 times between the interface and slave 0"),
        (errors(0, processing_unit=(1,), pdi=(2,)), NOTE, "processing unit 1, PDI 2"),
        (grown(counted(invalid=(5, 0, 0, 0)), counted()), FINE, "no new errors"),
        (grown(counted(invalid=(6, 0, 0, 0)), counted(forwarded=(1, 0, 0, 0))), BAD,
         "1 corrupted between the interface and slave 0; "),
        (grown(counted(), counted()), FINE, "no new errors"),  # a server was started meanwhile
        (late(20), FINE, ""), (late(150), NOTE, ""), (late(400), LOOK, ""), (late(20, 1), LOOK, "1 of 2001"),
        (exchanges(80, 80), FINE, ""), (exchanges(80, 300), NOTE, ""), (exchanges(80, 80, 1), LOOK, "1 f"),
        (exchanges(860, 860), LOOK, "samples are 380 µs older than through a PCIe network card"),
        *((bus_checks.age_finding("when sent", summary(p99_us)), level, "when sent")
          for p99_us, level in ((900, FINE), (1300, NOTE), (11_000, LOOK), (110_000, BAD))),
        (bus_checks.scheduling(80, real_time=True), FINE, "SCHED_FIFO 80"),
        (bus_checks.scheduling(80, real_time=False), NOTE, "not granted"),
        (bus_checks.scheduling(0, real_time=False), NOTE, "as requested"),
    ],
)  # fmt: skip
def test_what_is_said(found: CheckResult, level: Level, said: str) -> None:
    assert found.level is level
    assert said in f"{found.found} {found.why}"


def test_error_counters_are_where_the_standard_has_them() -> None:
    """0x0300 + 2 * port: invalid frames, + 1: of the physical layer; 0x0308, 0x030C, 0x030D, 0x0310."""
    found = bus_checks.ErrorCounters.parse(bytes(range(20)))
    assert found == ((0, 2, 4, 6), (1, 3, 5, 7), (8, 9, 10, 11), 12, 13, (16, 17, 18, 19))


def test_a_bus_without_a_sensor_is_bad_unless_one_of_its_slaves_may_be_one() -> None:
    coupler = slave(vendor=2, name="EK1100")
    [found] = bus_checks.any_sensor([coupler])
    assert (found.level, found.found) == (BAD, "no Bota Gen-0 sensor")
    for other in (slave(), slave(sii_problem="busy")):
        assert not [*bus_checks.any_sensor([coupler, other])]
