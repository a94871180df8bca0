"""The tool on a real interface: pysoem's frames, the kernel's tables of sockets and links, signals, pipes.

What it does with the sensors is tested in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ethercat_server.access.adapters import adapters
from ethercat_server.tool import bus as find
from tests.server.running import (
    Veth,
    VirtualSensor,
    needs_bus,
    server,
    virtual_sensor,
)
from tests.tool.running import one_sentence, refused, told, tool, tool_here

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, VirtualSensor]


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Two sensors of different models at 100 Hz, which takes little of the machine."""
    models = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
    options = ("--model", models, "--serial", "10,20", "--pdo", "77", "--sinc", "512", "--signal", "rest")
    with virtual_sensor(*options) as (veth, sensor):
        yield veth, sensor
        assert [sensor.stats(position)["calibration_writes"] for position in (0, 1)] == [0, 0]


def test_adapters_say_what_state_they_are_in(bench: Bench) -> None:
    """The states are the kernel's, and who uses an interface is found in its tables of sockets."""
    veth, sensor = bench
    found = {row["name"]: row for row in told("adapters")["adapters"]}
    near, far = found[veth.near], found[veth.far]
    assert (near["up"], near["carrier"], near["held_by"]) == (True, True, None)
    assert f"process {sensor.process.pid}" in far["held_by"]
    assert found["lo"]["loopback"]
    line = next(line for line in tool_here("adapters").out.splitlines() if line.startswith(veth.near))
    assert "up" in line


def test_find_looks_where_it_may(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The states are the kernel's, the frames pysoem's; of this machine's interfaces only the test's own."""
    veth, sensor = bench
    own = (veth.near, veth.far)
    monkeypatch.setattr(find, "adapters", lambda: [row for row in adapters() if row.name in own])
    found = {row["name"]: row for row in told("find")["interfaces"]}
    assert [row["serial"] for row in found[veth.near]["sensors"]] == [10, 20]
    assert f"process {sensor.process.pid}" in found[veth.far]["found"]
    assert "PROMISC" not in veth.ip("link", "show", veth.near)


def test_a_whole_command_on_the_interface(bench: Bench) -> None:
    """pysoem's SDO transfers and its way to PREOP, standard output that is a pipe, settings that stay."""
    veth, sensor = bench
    changed = ("--sensor", "20", "--set", "fir=on")
    assert told("apply", veth.near, *changed)["settings"]["fir"] is True
    assert '"serial": 20' in tool("snapshot", veth.near, "/dev/stdout", "--sensor", "20").out
    assert ("0x8006", 2, "00") in sensor.written(1), "FIR had been switched on"
    assert {row[0] for row in sensor.written(1)} == {"0x8006"}
    assert sensor.written(0) == []
    assert sensor.stats()["al_state"] == "INIT"


def test_a_server_that_holds_the_interface_is_found_and_said(bench: Bench) -> None:
    """Its process and port come from the kernel, its replies over a real socket."""
    veth, _ = bench
    with server(veth.near, "--rt-priority", "0", "--set", "sinc_length=512") as running:
        ended = tool_here("read", veth.near, "sampling rate", "--sensor", 0, "--json")
        used = f"the server at 127.0.0.1:{running.port}, process {running.process.pid}"
        assert used in one_sentence(ended)
        assert used in ended.json["through"]
        held = {row["name"]: row["held_by"] for row in told("adapters")["adapters"]}
        assert f"process {running.process.pid}" in held[veth.near]
        where = ("--server", f"localhost:{running.port}")
        assert "Sampling rate" in tool_here("read", *where, "sampling rate", "--sensor", 20).out


@pytest.mark.parametrize("where", ["localhost:1", "[::1]:1"])
def test_a_port_where_no_server_is(where: str) -> None:
    """Refused by the kernel; no address but a real one is."""
    said = refused("objects", "--server", where, "--json")
    assert f"no server at {where} " in said
