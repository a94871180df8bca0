"""The same through a running server, in memory and simulated time."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from tests.simulation import SimulatedBus, SimulatedServer, simulated_server
from tests.tool.running import refused, told, tool_here

Bench = tuple[SimulatedBus, SimulatedServer]
SERVER = ("--server", SimulatedServer.address)


@pytest.fixture
def bench(chain: SimulatedBus) -> Iterator[Bench]:
    with simulated_server(chain) as server:
        yield chain, server


def test_the_eeprom_is_read_while_the_server_streams(bench: Bench) -> None:
    _, server = bench
    found = told("eeprom", *SERVER)["slaves"]
    assert [(row["serial"], row["check_byte_right"]) for row in found] == [(10, True), (20, True)]
    assert [row["name"] for row in found] == ["BFT-SENS-ECAT-M8"] * 2
    assert [row["sync_managers"][3]["size"] for row in found] == [77, 77]
    assert "\n000e: 14|00|00|00\n" in tool_here("eeprom", *SERVER, "--sensor", "20").out
    assert server.events == []
    rows = server.client().ask("status")["sensors"]
    assert all(row["fresh"] > 20 for row in rows)
    assert [(row["lost_samples"], row["recoveries"]) for row in rows] == [(0, 0), (0, 0)]


@pytest.mark.usefixtures("bench")
def test_the_first_name_is_no_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BOTA_SERVER", SimulatedServer.address)
    found = told("read", "Sampling rate", "fir")["sensors"][0]["objects"]
    assert [row["name"] for row in found] == ["Sampling rate", "FIR disable"]
    assert len(told("read", "fir")["sensors"][0]["objects"]) == 1
    assert "did you mean Sampling rate" in refused("read", *SERVER, "sampling rte", code=2)


def test_what_is_said_to_last_outlasts_the_sensors_power(bench: Bench) -> None:
    bus, server = bench
    applied = tool_here("apply", "--sensor", 0, "--set", "sinc_length=128", *SERVER).out
    assert applied.splitlines()[-1].startswith("in force until the server is started again, also after")
    tared = tool_here("tare", "--sensor", 0, "--samples", 20, *SERVER).out
    assert "in force while the server runs, then until the sensor is powered off" in tared
    before = server.client().ask("describe")["sensors"][0]
    bus.power_cycle()
    server.run_until(lambda: any(event["event"] == "sensor_back" for event in server.events), "the event")
    after = server.client().ask("describe")["sensors"][0]
    assert (after["settings"]["sinc_length"], after["offset"]) == (128, before["offset"])
    assert any(after["offset"])
    assert (
        "nothing to change"
        in tool_here("apply", "--dry-run", "--sensor", 0, "--set", "sinc_length=128", *SERVER).out
    )


def test_a_tare_that_is_stopped_tells_what_came_of_it(bench: Bench) -> None:
    bus, server = bench
    bus.at(1.0, lambda: signal.raise_signal(signal.SIGINT))
    tared = tool_here("tare", "--samples", 200, "--sensor", 0, "--json", *SERVER)
    assert "continues the tare: waiting for its result" in tared.err
    held = server.client().ask("sdo_read", sensor=0, index=0x8000, subindex=1, type="f32")["value"]
    assert tared.json["new_offset"][0] == held == -1.5


def test_a_tare_that_is_stopped_twice_is_left_to_the_server(bench: Bench) -> None:
    bus, _ = bench
    for seconds in (0.5, 0.6):
        bus.at(seconds, lambda: signal.raise_signal(signal.SIGINT))
    left = tool_here("tare", "--samples", 200, "--sensor", 0, *SERVER, code=1)
    assert "it may still tare the sensor" in left.err.splitlines()[-1]


def test_a_sensor_that_is_out_does_not_hide_the_other(bench: Bench) -> None:
    bus, server = bench
    bus.command("power off @1")
    server.run_until(lambda: [event["event"] for event in server.events] == ["sensor_lost"], "the event")
    found = told("eeprom", *SERVER, "--sensor", 0)
    assert found["slaves"][0]["serial"] == 10
    tool_here("eeprom", *SERVER, "--sensor", 10)
    for words, key in ((("eeprom",), "slaves"), (("read", "Force/Torque Offset"), "sensors")):
        assert "sensor 1 is lost" in tool_here(*words, *SERVER, code=1).err
        rows = told(*words, *SERVER, code=1)[key]
        assert ("error" in rows[0], "error" in rows[1]) == (False, True)
        assert rows[0]["serial"] == 10


def test_a_server_that_does_not_reply_or_ends_is_one_sentence(bench: Bench) -> None:
    bus, server = bench

    def end() -> None:
        for connection in server.hub.connections.values():
            connection.close()
        server.hangs = True

    bus.at(0.1, end)
    said = refused("objects", *SERVER)
    assert f"the server at {server.address} closed the connection" in said
