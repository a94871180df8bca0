"""`find`: which interface has a sensor, and what is left alone. On made-up interfaces and simulated buses."""

from __future__ import annotations

import contextlib

import pytest

from bota_ethercat.address import Address
from ethercat_server.access import private_server
from ethercat_server.access.adapters import Adapter, Holder
from ethercat_server.errors import InterfaceError
from ethercat_server.ethercat.bus import Bus
from ethercat_server.ethercat.nic import Routes
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.tool import bus as find
from tests.json_schema import problems
from tests.simulation import SimulatedBus, chain, registers, simulated_server
from tests.tool.running import told, tool_here


def found(patch: pytest.MonkeyPatch, *adapters: Adapter, code: int = 0) -> dict[str, dict[str, object]]:
    """What `find --json` says on a machine with these interfaces, by name."""
    patch.setattr(find, "adapters", lambda: list(adapters))
    said = told("find", code=code)
    assert not problems("sensor", said, "find")
    rows = said["interfaces"]
    return {row["name"]: row for row in rows}


def test_the_interface_with_the_sensors_is_found(
    models: SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = registers(models.backend)
    row = found(monkeypatch, Adapter("lo", loopback=True), Adapter("ens5"))["ens5"]
    assert row["sensors"] == [
        {"sensor": 0, "position": 0, "name": "BFT-SENS-ECAT-M8", "serial": 10},
        {"sensor": 1, "position": 1, "name": "BFT-ROKS-ECAT-M8", "serial": 20},
    ]
    assert [models.stats(n)["al_state"] for n in (0, 1)] == ["INIT", "INIT"]
    assert [data[0x10:0x140] for data in registers(models.backend)] == [data[0x10:0x140] for data in before]
    shown = tool_here("find").out
    assert "ens5       BFT-SENS-ECAT-M8, serial 10; BFT-ROKS-ECAT-M8, serial 20" in shown
    assert "lo         left alone: loopback" in shown
    assert shown.index("ens5") < shown.index("lo  "), "what matters comes first"


@pytest.mark.parametrize(
    ("adapter", "why"),
    [
        (Adapter("x", loopback=True), "loopback"),
        (Adapter("x", routes=Routes(default=True)), "default route"),
        (Adapter("x", routes=Routes(("10.0.0.2/24",))), "10.0.0.2/24"),
        (Adapter("x", up=False, carrier=False), "'sudo ip link set x up'"),
        (Adapter("x", carrier=False), "no carrier"),
        (Adapter("x", kind="bridge"), "bridge"),
        (Adapter("x", ethernet=False), "no wired Ethernet"),
        (Adapter("x", master="br0"), "part of a bridge, bond or VLAN"),
        (Adapter("x", holder=Holder(77, "codesys", None)), "in use by process 77 (codesys)"),
    ],
)
def test_what_is_no_candidate_is_not_even_opened(
    monkeypatch: pytest.MonkeyPatch, adapter: Adapter, why: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        pytest.fail("it was opened")

    monkeypatch.setattr(private_server, "open_bus", fail)
    row = found(monkeypatch, adapter, code=1)["x"]
    assert why in str(row["found"])
    assert not row["looked"]


def test_other_interfaces_without_a_sensor_are_told_apart(
    models: SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty, foreign, at_work = MemoryBackend(), chain("EK1100"), chain("BOTA,DRIVE:OP")
    empty.command("power off")
    buses = {"empty": empty, "foreign": foreign, "at_work": at_work, "ens5": models.backend}

    def open_bus(ifname: str, **_: object) -> contextlib.closing[Bus]:
        if ifname == "denied":
            raise InterfaceError("not allowed to open denied: CAP_NET_RAW missing; run with sudo")
        return contextlib.closing(Bus(buses[ifname]))

    before = registers(at_work)
    with monkeypatch.context() as patch:  # undone before that of the fixture
        patch.setattr(private_server, "open_bus", open_bus)
        rows = found(monkeypatch, *(Adapter(name) for name in (*buses, "denied")))
    assert rows["empty"]["found"] == "no EtherCAT slave answers"
    assert rows["foreign"]["found"] == "another EtherCAT slave"
    assert "has slaves at work that are not Bota sensors (position 1 in OP)" in str(rows["at_work"]["found"])
    assert registers(at_work) == before
    assert "run with sudo" in str(rows["denied"]["found"])
    assert [name for name, row in rows.items() if row["sensors"]] == ["ens5"]


def test_a_server_is_asked_for_its_sensors(models: SimulatedBus, monkeypatch: pytest.MonkeyPatch) -> None:
    with simulated_server(models):
        holder = Holder(12, "ethercat-server", Address("127.0.0.1", 12001))
        row = found(monkeypatch, Adapter("ens5", holder=holder))["ens5"]
    assert "serial 10" in str(row["found"])
    assert "through the server at 127.0.0.1:12001, process 12 (ethercat-server)" in str(row["found"])
