"""The doctor where a server uses the interface: its figures and clients, and not one frame of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from bota_ethercat.address import Address
from bota_ethercat.health.verdict import Level
from ethercat_server.access.holder import Holder
from ethercat_server.access.sensors import Sensors
from ethercat_server.doctor import bus_checks
from ethercat_server.doctor.bus_checks import ServerView
from tests.doctor.running import examined
from tests.simulated_links import SINC_LENGTH, SimulatedServer, simulated_bus, simulated_server
from tests.simulation import SimulatedBus

Bench = tuple[SimulatedBus, SimulatedServer]
ADDRESS = Address("127.0.0.1", 12001)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    holder = Holder(os.getpid(), "ethercat-server", ADDRESS)
    monkeypatch.setattr(bus_checks, "find_holder", lambda _: holder)
    with (
        simulated_bus("--sensors", "2", "--serial", "10,20", "--sinc", SINC_LENGTH) as bus,
        simulated_server(bus) as server,
    ):
        yield bus, server


def test_its_figures_and_clients_instead_of_the_bus(bench: Bench, tmp_path: Path) -> None:
    bus, server = bench
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


def test_without_measuring_it_does_not_wait(bench: Bench, tmp_path: Path) -> None:
    bus, _ = bench
    before_ns = bus.clock.now_ns
    assert examined(bus, tmp_path, 0).levels("server")["server"] == "ok"
    assert bus.clock.now_ns - before_ns < 1e9


def test_losses_show(bench: Bench, tmp_path: Path) -> None:
    bus, server = bench
    bus.command("power cycle 0.2 @1")
    server.run_until(lambda: [event["event"] for event in server.events][-1:] == ["sensor_back"], "the event")
    before, after = (finding for finding in examined(bus, tmp_path, 0.5) if finding.check == "sensors")
    assert after.level > Level.GOOD
    assert (before.values["recoveries"], after.values["recoveries"]) == (0, 1)


def test_losses_while_it_looks_are_told(bench: Bench, tmp_path: Path) -> None:
    bus, _ = bench
    bus.at(0.5, "deaf 0.04")
    sensor = examined(bus, tmp_path, 1.0).of("server")["sensors"]
    assert sensor.level is Level.LOOK, "four samples of a hundred, in one place"
    assert "samples (4 %) were lost" in sensor.found
    assert sensor.values["new_invalid"] > 0


def test_a_lost_sensor_is_bad(bench: Bench, tmp_path: Path) -> None:
    bus, server = bench
    bus.command("power off @1")
    server.run_until(lambda: server.events, "the event")
    found = examined(bus, tmp_path, 0.5)
    assert found.worst is Level.TROUBLE
    sensor = found.of("server")["sensors"]
    assert (sensor.level, sensor.values["verdict"]) == (Level.TROUBLE, "trouble")
    assert [finding.check for finding in found].count("server") == 1


def test_a_server_that_hangs_is_bad(bench: Bench, tmp_path: Path) -> None:
    bus, server = bench
    server.hangs = True
    found = examined(bus, tmp_path, 0)
    assert found.worst is Level.TROUBLE
    assert "no reply to describe within 5 s" in found.of("server")["server"].found


def test_a_computer_that_stood_still_is_blamed_in_place_of_the_cable() -> None:
    def status(count: int) -> dict[str, Any]:
        row = dict.fromkeys(("fresh", "repeated", "invalid", "lost_samples"), 0)
        row |= {"sensor": 0, "recoveries": count}
        return {"sensors": [{**row, "clock": {"mode": "locked"}}], "missed_deadlines": 24 * count}

    statuses = iter((status(0), status(1)))
    sensor = {"sensor": 0, "name": "", "serial": 1, "rate_hz": 800.0, "state": "OP"}
    link = SimpleNamespace(
        clock=SimpleNamespace(monotonic_ns=lambda: 0), listen=lambda *_: [], same_machine=True,
        ask=lambda action: {"sensors": [sensor]} if action == "describe" else next(statuses),
        close=lambda: None,
    )  # fmt: skip
    view = ServerView(cast("Sensors", link), 1.0, own=False)
    [finding] = view.sensors()
    assert "The server lost the sensor once and has it back" in finding.found
    assert "computer stood still" in finding.why
