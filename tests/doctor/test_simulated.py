"""The doctor on a simulated bus, and where a server uses it: then not one frame of its own."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from bota_ethercat.address import Address
from bota_ethercat.health.limits import Level
from bota_ethercat.replies import Description, Status
from bota_ethercat.stream.timeline import Timeline
from ethercat_server.access.adapters import Holder
from ethercat_server.access.sensors import Sensors
from ethercat_server.doctor import bus_checks
from ethercat_server.doctor.bus_checks import ServerView
from ethercat_server.doctor.report import examine
from tests.doctor.running import examined
from tests.simulation import (
    RATE_HZ,
    SINC_LENGTH,
    SimulatedBus,
    SimulatedServer,
    life_of,
    registers,
    simulated_bus,
    simulated_server,
)

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


def test_what_is_found_and_measured_and_left_as_it_is(bench: SimulatedBus, tmp_path: Path) -> None:
    announced: list[str] = []
    findings = examined(bench, tmp_path, 1.0, announce=announced.append)
    found, on_bus = findings.of("measurement"), findings.of("bus")
    assert on_bus["slaves"].values == {"slaves": 2}
    assert [on_bus[f"slave {n}"].found.partition(", supp")[0] for n in range(2)] == [
        "BFT-SENS-ECAT-M8, serial 10",
        "BFT-ROKS-ECAT-M8, serial 20",
    ]
    assert set(findings.levels("bus").values()) == {"ok"}
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
    assert wake_ups.level is Level.LOOK, "a cause; whether it is trouble the stream tells"


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


def test_another_master_is_not_disturbed(
    single: SimulatedBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for holder, level, named, commands in (
        (Holder(77, "codesys", None), Level.TROUBLE, "process 77 (codesys)", ("sudo kill 77",)),
        (Holder(None, "", None), Level.NOT_POSSIBLE, "or outside of this container, has it", ()),
    ):
        monkeypatch.setattr(bus_checks, "find_holder", lambda _, who=holder: who)
        found = examined(single, tmp_path, LOOK).of("bus")["slaves"]
        assert (found.level, found.commands, named in found.found) == (level, commands, True)
        assert single.backend.sensors.frames == 0


@pytest.mark.parametrize("chain", ["BOTA:OP,DRIVE:OP", "EK1100,DRIVE:OP,EL3102:PREOP,BOTA"])
def test_nothing_is_written_to_a_drive_at_work_or_beside_it(chain: str, tmp_path: Path) -> None:
    """Its master has the whole bus, and may be in the middle of anything with the others."""
    with simulated_bus("--chain", chain) as bus:
        before = registers(bus.backend)
        found = examined(bus, tmp_path).of("bus")["slave 1"]
        assert (found.level, "not a Bota sensor, and in OP" in found.found) == (Level.TROUBLE, True)
        places = [place for place, name in enumerate(chain.split(",")) if not name.startswith("BOTA")]
        assert [bus.stats_of_foreign(place)["write_count"] for place in places] == [0] * len(places)
        assert [now for now, then in zip(registers(bus.backend), before, strict=True) if now != then] == []


Served = tuple[SimulatedBus, SimulatedServer]
ADDRESS = Address("127.0.0.1", 12001)


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    holder = Holder(os.getpid(), "ethercat-server", ADDRESS)
    monkeypatch.setattr(bus_checks, "find_holder", lambda _: holder)
    with (
        simulated_bus("--sensors", "2", "--serial", "10,20", "--sinc", SINC_LENGTH) as bus,
        simulated_server(bus) as server,
    ):
        yield bus, server


def test_its_figures_and_clients_instead_of_the_bus(served: Served, tmp_path: Path) -> None:
    bus, server = served
    assert server.client().ask("subscribe")["ok"]
    findings = examined(bus, tmp_path, 1.0)
    found = findings.of("server")
    assert set(found) == {"server", "sensors", "wake-ups", "exchanges", "age of data", "clients"}
    assert [finding.check for finding in findings].count("server") == 1
    assert f"process {os.getpid()}" in found["server"].found
    assert found["server"].values["port"] == ADDRESS.port
    assert not findings.of("bus")
    assert not findings.of("measurement"), "its loop is the measurement"
    sensors = [finding for finding in findings if finding.check == "sensors"]
    assert [finding.values["serial"] for finding in sensors] == [10, 20]
    assert all(finding.values["state"] == "OP" for finding in sensors)
    assert [finding.values["new_fresh"] for finding in sensors] == pytest.approx([100, 100], abs=2)
    assert 40 < found["exchanges"].values["p50"] < 100
    assert len(found["clients"].values["clients"]) == 2
    assert "1 beside the doctor" in found["clients"].found
    assert bus.stats()["al_state"] == "OP"


def test_without_measuring_it_does_not_wait(served: Served, tmp_path: Path) -> None:
    bus, _ = served
    before_ns = bus.clock.now_ns
    assert examined(bus, tmp_path, 0).levels("server")["server"] == "ok"
    assert bus.clock.now_ns - before_ns < 1e9


def test_losses_show(served: Served, tmp_path: Path) -> None:
    bus, server = served
    bus.command("power cycle 0.2 @1")
    server.run_until(lambda: [event["event"] for event in server.events][-1:] == ["sensor_back"], "the event")
    before, after = (finding for finding in examined(bus, tmp_path, 0.5) if finding.check == "sensors")
    assert after.level > Level.GOOD
    assert (before.values["recoveries"], after.values["recoveries"]) == (0, 1)


def test_losses_while_it_looks_are_told(served: Served, tmp_path: Path) -> None:
    bus, _ = served
    sampling, period_s = life_of(bus.backend, 1).sampler.clock, 1 / RATE_HZ
    # From between two samples to between two others: the poll after it still brings the last of four.
    begin_ns = sampling.instant(sampling.number_at(bus.clock.now_ns) + RATE_HZ // 2)
    bus.at((begin_ns - bus.clock.now_ns) * 1e-9 + period_s / 3, f"deaf {4 * period_s}")
    sensor = examined(bus, tmp_path, 1.0).of("server")["sensors"]
    assert sensor.level is Level.LOOK, "three samples of a hundred, in one place"
    assert re.search(r": 3 of \d+ samples \(3(\.1)? %\) were lost", sensor.found), sensor.found
    assert sensor.values["new_lost_samples"] == 3
    assert sensor.values["new_invalid"] > 0


def test_a_server_that_hangs_is_bad(served: Served, tmp_path: Path) -> None:
    bus, server = served
    server.hangs = True
    found = examined(bus, tmp_path, 0)
    assert found.worst is Level.TROUBLE
    assert "no reply to describe within 5 s" in found.of("server")["server"].found


def test_a_computer_that_stood_still_is_blamed_in_place_of_the_cable() -> None:
    def status(count: int) -> dict[str, Any]:
        row = dict.fromkeys(("fresh", "repeated", "invalid", "lost_samples"), 0)
        row |= {"sensor": 0, "recoveries": count}
        sensors = [{**row, "clock": {"mode": "locked"}}]
        return {"sensors": sensors, "missed_deadlines": 24 * count, "last_10s": {}}

    statuses = iter((status(0), status(1)))
    sensor = {"sensor": 0, "name": "", "serial": 1, "rate_hz": 800.0, "state": "OP"}
    link = SimpleNamespace(
        clock=SimpleNamespace(monotonic_ns=lambda: 0), private=None, close=lambda: None,
        client=SimpleNamespace(session=SimpleNamespace(timeline=Timeline())),
        describe=lambda: Description.parse({"sensors": [sensor]}),
        status=lambda: Status.parse(next(statuses)),
    )  # fmt: skip
    view = ServerView(cast("Sensors", link), 0.0)
    [finding] = examine("server", "sensors", view.sensors)
    assert "The server lost the sensor once and has it back" in finding.found
    assert "computer stood still" in finding.why
    assert "see the checks of machine and bus" in finding.why
    assert "ethercat-doctor" not in finding.why
