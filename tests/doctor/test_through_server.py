"""The doctor where a server holds the interface: its figures and clients, and not one frame on the bus."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from tests.doctor.running import doctor, levels
from tests.server.commands import command, stats
from tests.server.running import Program, Server, Veth, needs_bus, server, virtual_sensor, wait_until

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, Program, Server]
QUICK = ("--json", "--seconds", "0.5")


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with (
        virtual_sensor("--sensors", "2", "--serial", "10,20") as (veth, sensor),
        server(veth.near, "--rt-priority", "0") as running,
    ):
        yield veth, sensor, running


def test_its_figures_and_clients_instead_of_the_bus(bench: Bench) -> None:
    veth, sensor, running = bench
    with running.connect() as client:
        client.ask("subscribe")
        ended = doctor(veth.near, *QUICK)
    found = ended.findings("server")
    assert set(found) == {"server", "sensors", "wake-ups", "exchanges", "age of data", "clients"}
    assert f"process {running.process.pid}" in found["server"]["found"]
    assert found["server"]["values"]["port"] == running.port
    assert not ended.findings("bus")
    assert not ended.findings("measurement"), "its loop is the measurement"
    sensors = [row for row in ended.json["findings"] if row["check"] == "sensors"]
    assert [row["values"]["serial"] for row in sensors] == [10, 20]
    assert all(row["values"]["state"] == "OP" for row in sensors)
    assert found["exchanges"]["values"]["p50"] > 0
    assert len(found["clients"]["values"]["clients"]) == 2
    assert "1 beside the doctor" in found["clients"]["found"]
    assert stats(sensor)["al_state"] == "OP"


def test_without_measuring_it_does_not_wait(bench: Bench) -> None:
    veth, _, _ = bench
    assert doctor(veth.near, "--json", "--seconds", "0").findings("server")["server"]["level"] == "ok"


def test_losses_show(bench: Bench) -> None:
    veth, sensor, running = bench
    command(sensor, "power cycle 0.2 @1")
    with running.connect() as client:
        wait_until(lambda: client.ask("status")["sensors"][1]["recoveries"] >= 1, "the recovery")
    rows = [row for row in doctor(veth.near, *QUICK).json["findings"] if row["check"] == "sensors"]
    assert rows[1]["level"] != "ok"
    assert rows[1]["values"]["recoveries"] >= 1


def test_a_lost_sensor_is_bad() -> None:
    with virtual_sensor() as (veth, sensor), server(veth.near, "--rt-priority", "0"):
        command(sensor, "power off")
        wait_until(lambda: not stats(sensor)["powered"], "it")
        ended = doctor(veth.near, *QUICK)
        assert ended.code == 4
        assert ended.findings("server")["sensors"]["level"] == "bad"


def test_who_may_not_see_which_process_it_is(bench: Bench) -> None:
    veth, _, _ = bench
    ended = doctor(veth.near, *QUICK, module="tests.doctor.as_nobody")
    found = ended.findings("bus")["slaves"]
    assert found["level"] == "skipped"
    assert "an EtherCAT master has it, and only root can see which" in found["found"]
    assert levels(ended.findings("measurement"))["wake-ups"] in {"ok", "note", "warning", "bad"}


def test_a_server_that_hangs_is_bad() -> None:
    with virtual_sensor() as (veth, _), server(veth.near, "--rt-priority", "0") as running:
        running.signal(signal.SIGSTOP)
        try:
            ended = doctor(veth.near, "--json", "--seconds", "0")
        finally:
            running.signal(signal.SIGCONT)
    assert ended.code == 4
    assert "no reply to describe within 5 s" in ended.findings("server")["server"]["found"]
