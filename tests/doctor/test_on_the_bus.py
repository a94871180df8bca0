"""The doctor's examination of a bus and its measurement, on simulated sensors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bota_ethercat.health.verdict import Level
from ethercat_server.access.holder import Holder
from ethercat_server.doctor import bus_checks
from ethercat_server.ethercat.nic import Routes
from tests.doctor.made_up import but
from tests.doctor.running import examined
from tests.simulated_links import registers, simulated_bus, simulated_server
from tests.simulation import SimulatedBus

LOOK = 0.0
"""No measurement."""


@pytest.fixture
def bench() -> Iterator[SimulatedBus]:
    """Two sensors of different models."""
    models = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
    with simulated_bus("--model", models, "--serial", "10,20") as bus:
        yield bus


@pytest.fixture
def single() -> Iterator[SimulatedBus]:
    with simulated_bus() as bus:
        yield bus


def test_sensors_are_found_and_left_as_they_are(bench: SimulatedBus, tmp_path: Path) -> None:
    found = examined(bench, tmp_path, LOOK)
    on_bus = found.of("bus")
    assert on_bus["slaves"].values == {"slaves": 2}
    assert [on_bus[f"slave {n}"].found.partition(", supp")[0] for n in range(2)] == [
        "BFT-SENS-ECAT-M8, serial 10",
        "BFT-ROKS-ECAT-M8, serial 20",
    ]
    assert set(found.levels("bus").values()) == {"ok"}
    for position in range(2):
        now = bench.stats(position)
        assert (now["al_state"], now["al_error"], now["sdo_write_count"]) == ("INIT", False, 0)


def test_what_is_measured(bench: SimulatedBus, tmp_path: Path) -> None:
    announced: list[str] = []
    findings = examined(bench, tmp_path, 1.0, announce=announced.append)
    found = findings.of("measurement")
    assert set(found) == {
        "scheduling", "sensors", "wake-ups", "exchanges", "age of data", "card meanwhile", "bus meanwhile",
    }  # fmt: skip
    sensors = [finding for finding in findings if finding.check == "sensors" and finding.values]
    assert [finding.values["serial"] for finding in sensors] == [10, 20]
    assert all(finding.values["new_fresh"] > 700 for finding in sensors)
    exchange, age = (found[name].values for name in ("exchanges", "age of data"))
    assert 40 <= exchange["p50"] <= exchange["p99"] <= exchange["max"]
    assert age["p50"] > exchange["p50"] / 2
    assert findings.levels("measurement")["bus meanwhile"] == "ok"
    assert announced == ["measuring for 1 s ..."]
    for position in range(2):
        now = bench.stats(position)
        assert (now["al_state"], now["al_error"], now["sdo_write_count"]) == ("INIT", False, 0)


def test_a_machine_that_stalls_shows_in_the_measurement(single: SimulatedBus, tmp_path: Path) -> None:
    for n in range(5):
        single.at(0.704 + 0.05 * n, lambda: single.clock.stall(3e6))  # between two exchanges
    wake_ups = examined(single, tmp_path, 1.0).of("measurement")["wake-ups"]
    assert wake_ups.values["max"] > 2000
    assert wake_ups.level > Level.GOOD


def test_a_sensor_that_lost_its_master_is_told_and_left_so(single: SimulatedBus, tmp_path: Path) -> None:
    with simulated_server(single):
        single.command("safeop 0x1B")
    for _ in range(2):
        found = examined(single, tmp_path, LOOK).of("bus")
        assert found["slave 0"].level is Level.GOOD, "its EEPROM belonged to the firmware, and does again"
        assert found["slave 0 state"].level is Level.NOTE
        assert found["slave 0 state"].found.startswith("SAFEOP with AL status 0x001B")
        now = single.stats()
        assert (now["al_state"], now["al_error"], now["al_status_code"]) == ("SAFEOP", True, 0x1B)


def test_damaged_frames_are_told_with_their_cable(bench: SimulatedBus, tmp_path: Path) -> None:
    bench.command("flap @1")
    lost = examined(bench, tmp_path, LOOK).of("bus")["slave 1 errors"]
    assert lost.found == "link lost 1 times between slave 0 and slave 1"
    assert lost.level is Level.NOTE
    bench.command("damage 3 @1")
    found = examined(bench, tmp_path, LOOK)
    assert found.worst is Level.LOOK
    on_bus = found.of("bus")
    assert on_bus["slaves"].values == {"slaves": 2}, "it tries again"
    assert on_bus["slave 1 errors"].level is Level.LOOK
    assert "3 corrupted between slave 0 and slave 1" in on_bus["slave 1 errors"].found
    assert on_bus["slave 0 errors"].level is Level.NOTE, "damage that others found"


def test_frames_damaged_while_it_measures_are_bad(bench: SimulatedBus, tmp_path: Path) -> None:
    bench.at(0.7, "damage 5 1")
    found = examined(bench, tmp_path, 1.0).of("measurement")["bus meanwhile"]
    assert found.level is Level.TROUBLE
    assert "5 corrupted between slave 0 and slave 1" in found.found


def test_devices_that_the_server_would_refuse(single: SimulatedBus, tmp_path: Path) -> None:
    single.command("swap EK1100 5")
    found = examined(single, tmp_path, LOOK).of("bus")["slave 0"]
    assert found.level is Level.TROUBLE
    assert "EK1100, serial 5" in found.found


def test_nothing_answers(single: SimulatedBus, tmp_path: Path) -> None:
    single.command("deaf")
    found = examined(single, tmp_path)
    assert found.worst is Level.TROUBLE
    assert found.of("bus")["slaves"].found == "no EtherCAT slave answers"
    assert found.levels("measurement") == {"all": "skipped"}


def test_a_sensor_that_goes_away_while_it_measures(single: SimulatedBus, tmp_path: Path) -> None:
    single.at(0.7, "deaf")
    found = examined(single, tmp_path, 1.0).levels("measurement")
    assert (found["sensors"], found["bus meanwhile"]) == ("bad", "bad")


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"link": {"up": False, "carrier": False}}, "it is down"),
        ({"link": {"carrier": False}}, "it has no carrier"),
        ({"link": {"loopback": True}}, "it is the loopback interface"),
        ({"link": {"master": "br0"}}, "part of a bridge"),
        ({"link": {"upper": ("ens5.7",)}}, "part of a bridge, bond or VLAN"),
        ({"routes": Routes(leased=("192.0.2.77/32",))}, "has the IP address 192.0.2.77/32 by DHCP"),
        ({"routes": Routes(default=True)}, "has the machine's default route"),
        ({"routes": "Permission denied"}, "its IP configuration is unknown (Permission denied)"),
    ],
)
def test_interfaces_where_no_frame_is_sent(
    single: SimulatedBus, tmp_path: Path, changes: dict[str, Any], why: str
) -> None:
    found = examined(single, tmp_path, 0.02, facts=but(**changes))
    assert found.of("bus")["slaves"].level is Level.NOT_POSSIBLE
    assert why in found.of("bus")["slaves"].found
    assert found.levels("measurement") == {"all": "skipped"}
    assert single.backend.sensors.frames == 0


def test_without_rights_it_says_what_it_skipped(single: SimulatedBus, tmp_path: Path) -> None:
    status = "Name:\tpython\nCapEff:\t0000000000000000\n"
    found = examined(single, tmp_path, 0.02, files={"/proc/self/status": status})
    skipped = found.of("bus")["slaves"]
    assert skipped.found == "not checked: CAP_NET_RAW and CAP_NET_ADMIN missing; run with sudo"
    assert found.levels("measurement") == {"all": "skipped"}
    assert single.backend.sensors.frames == 0


@pytest.mark.parametrize(
    ("holder", "level", "named", "commands"),
    [
        (Holder(77, "codesys", None), Level.TROUBLE, "process 77 (codesys)", ("sudo kill 77",)),
        (Holder(None, "", None), Level.NOT_POSSIBLE, "an EtherCAT master of another user has it", ()),
    ],
)
def test_another_master_is_not_disturbed(
    single: SimulatedBus,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    holder: Holder,
    level: Level,
    named: str,
    commands: tuple[str, ...],
) -> None:
    monkeypatch.setattr(bus_checks, "find_holder", lambda _: holder)
    found = examined(single, tmp_path, LOOK).of("bus")["slaves"]
    assert (found.level, found.commands) == (level, commands)
    assert named in found.found
    assert single.backend.sensors.frames == 0


def test_a_drive_at_work_is_not_touched(tmp_path: Path) -> None:
    with simulated_bus("--chain", "BOTA:OP,DRIVE:OP") as bus:
        found = examined(bus, tmp_path).of("bus")["slave 1"]
        assert found.level is Level.TROUBLE
        assert "not a Bota sensor, and in OP" in found.found
        assert bus.stats_of_foreign(1)["write_count"] == 0


def test_nothing_is_written_beside_a_drive_at_work(tmp_path: Path) -> None:
    """Its master has the whole bus, and may be in the middle of anything with the others."""
    with simulated_bus("--chain", "EK1100,DRIVE:OP,EL3102:PREOP,BOTA") as bus:
        before = registers(bus.backend)
        result = examined(bus, tmp_path)
        assert result.of("bus")["slave 1"].level is Level.TROUBLE
        assert [bus.stats_of_foreign(place)["write_count"] for place in (0, 1, 2)] == [0, 0, 0]
        assert registers(bus.backend)[3] == before[3]
