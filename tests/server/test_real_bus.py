"""What only a real interface shows: pysoem, raw sockets, links that go down, processes that are stopped.

Each kind of recovery once, to see that the real backend does what the one in memory does; everything else
about recovery is in test_recovery.py. One server for all; the last test ends it.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.server.commands import command, stats
from tests.server.running import Client, Program, Server, Veth, needs_bus, server, virtual_sensor, wait_until
from tests.simulation import reading

pytestmark = [pytest.mark.bus, needs_bus]


class RealBench:
    """A server on a veth pair, a virtual sensor that takes commands on its other end."""

    def __init__(self, veth: Veth, sensor: Program, running: Server) -> None:
        self.veth, self.sensor, self.running = veth, sensor, running

    def command(self, text: str) -> str:
        return command(self.sensor, text)


@pytest.fixture(scope="module")
def bench() -> Iterator[RealBench]:
    with (
        virtual_sensor("--signal", "clock", "--ppm", "150") as (veth, sensor),
        server(veth.near, "--set", "acceleration_range_g=8") as running,
    ):
        yield RealBench(veth, sensor, running)


@pytest.fixture
def client(bench: RealBench) -> Iterator[Client]:
    with bench.running.connect() as client:
        client.ask("subscribe")
        client.fresh(50)
        client.events.clear()
        yield client


def pull_cable(bench: RealBench, client: Client) -> None:
    bench.veth.ip("link", "set", bench.veth.far, "down")
    assert f"{bench.veth.near} has no carrier" in client.wait_event("sensor_lost")["reason"]
    bench.veth.ip("link", "set", bench.veth.far, "up")


def be_deaf(bench: RealBench, client: Client) -> None:
    bench.command("deaf")
    client.wait_event("sensor_lost")
    bench.command("hear")


def cut_power(bench: RealBench, client: Client) -> None:
    bench.command("power off")
    client.wait_event("sensor_lost")
    bench.command("power on")


def drop_to_safeop(bench: RealBench, client: Client) -> None:
    bench.command("safeop 0x1B")
    client.wait_event("sensor_lost")


def stop_server(bench: RealBench, _: Client) -> None:
    """The sensor falls to SAFEOP meanwhile; the server takes it back to OP."""
    bench.running.signal(signal.SIGSTOP)
    bench.command("safeop 0x1B")
    bench.running.signal(signal.SIGCONT)


@pytest.mark.parametrize("fault", [pull_cable, be_deaf, cut_power, drop_to_safeop, stop_server])
def test_samples_flow_again_on_the_same_connection(
    bench: RealBench, client: Client, fault: Callable[[RealBench, Client], None]
) -> None:
    """With the kernel's links and timers: a link that is down fails the sending, a process that was stopped
    finds frames of before."""
    fault(bench, client)
    assert client.wait_event("sensor_back")["settings"]["acceleration_range_g"] == 8
    frames = client.fresh(100)
    instants = [reading(frame).instant_ns for frame in frames]
    assert instants == sorted(set(instants)), "nothing old as new"
    wait_until(lambda: client.ask("describe")["sensors"][0]["state"] == "OP", "OP")
    assert stats(bench.sensor)["calibration_writes"] == 0


def test_settings_change_by_way_of_preop(bench: RealBench, client: Client) -> None:
    """The mailbox by single datagrams over the raw socket, while pysoem's own are not used any more."""
    for settings in ({"chop": True, "imu_active": 3}, {"chop": False, "imu_active": 1}):
        wait_until(lambda new=settings: client.ask("configure", settings=new)["ok"], "it takes")  # type: ignore[misc]
        assert settings.items() <= client.wait_event("reconfigured")["settings"].items()
    assert len(client.fresh(20)) == 20


def test_a_second_master_on_the_interface_is_kept_away(bench: RealBench, client: Client) -> None:
    """Two processes."""
    second = Server(bench.veth.near)
    try:
        assert second.wait() == 1
        assert f"{bench.veth.near} is in use by another EtherCAT master" in second.said()
    finally:
        second.close()
    assert len(client.fresh(100)) == 100


def test_a_client_that_has_said_all_still_gets_its_samples(client: Client) -> None:
    """The kernel's half-closed connection."""
    client.sock.shutdown(1)
    assert len(client.fresh(100)) == 100


def test_an_interface_that_disappears_ends_the_server_with_a_sentence(bench: RealBench) -> None:
    """The kernel's error for a raw socket whose interface is gone."""
    veth, running = bench.veth, bench.running
    veth.ip("link", "del", veth.near)
    assert running.wait() == 1
    assert f"the interface {veth.near} has disappeared" in running.said()
    assert "Traceback" not in running.said()


@pytest.mark.parametrize("text", ["EK1100,BOTA,EL3102,DRIVE", "DRIVE:PREOP,BOTA,BOTA"])
def test_sensors_among_other_devices(text: str) -> None:
    """The master by single datagrams on a raw socket that pysoem opened."""
    with (
        virtual_sensor("--chain", text, "--signal", "clock") as (veth, sensor),
        server(veth.near) as running,
        running.connect() as client,
    ):
        described = client.ask("subscribe")
        assert [row["position"] for row in described["others"]] == [
            at for at, kind in enumerate(text.split(",")) if kind != "BOTA"
        ]
        assert len(client.fresh(200)) == 200
        before = foreign(sensor)
        pull_cable(RealBench(veth, sensor, running), client)
        client.wait_event("sensor_back")
        assert len(client.fresh(200)) == 200
        assert foreign(sensor) == before
        assert {row["al_state"] for row in before} <= {"INIT", "PREOP"}


def test_a_drive_at_work_is_not_touched() -> None:
    """pysoem opens the interface; nothing is written."""
    with virtual_sensor("--chain", "BOTA:OP,DRIVE:OP") as (veth, sensor):
        refused = Server(veth.near)
        try:
            assert refused.wait() == 1
            assert "no Bota sensors (position 1 in OP)" in refused.said()
        finally:
            refused.close()
        assert [row["write_count"] for row in foreign(sensor)] == [0]


def foreign(sensor: Program) -> list[dict[str, Any]]:
    """What the slaves that are no sensors say of themselves."""
    answer = command(sensor, "stats").removeprefix("ok ")
    return list(json.loads(answer)["foreign"].values())
