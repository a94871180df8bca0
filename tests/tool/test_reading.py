"""`eeprom`, `objects`, and `read` without a server, on simulated sensors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.sensor.objects.dictionary import KNOWN_OBJECTS
from ethercat_server.virtual_sensor.foreign import ForeignSlave
from tests.simulation import SimulatedBus, SimulatedServer, registers, simulated_bus, simulated_server
from tests.tool.odd_firmware import fewer_objects
from tests.tool.running import refused, told, tool_here


@pytest.fixture
def bench() -> Iterator[SimulatedBus]:
    """One sensor with 61 bytes of process data that gives the same numbers for ever."""
    with simulated_bus("--signal", "constant", "--noise", "none", "--serial", "4711", "--sinc", "512") as bus:
        yield bus


@pytest.mark.parametrize(
    ("arguments", "head"),
    [
        (("adapters",), "adapter  state  address  use"),
        (("find",), "interface  found"),
        (("eeprom", "NEAR"), "word  bytes"),
        (("objects", "NEAR"), "object  name  value  access  meaning"),
        (("read", "NEAR", "fir"), "object  name  value  access  meaning"),
        (("apply", "NEAR", "--set", "fir=true", "--dry-run"), "setting  now  then  meaning"),
        (("tare", "NEAR", "--clear"), "axis  old offset  new offset  unit"),
        (
            ("filters", "--loop", "500"),
            "SINC  FIR  rate  cut-off  noise  limit  delay  5  10  20  50  margin",
        ),
    ],
)
def test_each_table_has_a_head_of_all_its_columns(
    arguments: tuple[str, ...], head: str, bench: SimulatedBus
) -> None:
    given = [bench.near if each == "NEAR" else each for each in arguments]
    given += ["--sensor", "0"] if "tare" in given else []
    shown = tool_here(*given, code=None).out.splitlines()
    assert head in [re.sub(" {2,}", "  ", line.strip()) for line in shown]


def test_eeprom_shows_the_words_and_what_they_mean(bench: SimulatedBus) -> None:
    shown = tool_here("eeprom", bench.near).out
    assert "\n0008: 7a|b0|00|00\n" in shown, "as the note's script prints it"
    assert "\n007e: " in shown
    found = told("eeprom", bench.near)["slaves"][0]
    assert (found["vendor"], found["product"], found["revision"], found["serial"]) == (0xB07A, 1, 3, 4711)
    assert found["name"] == "BFT-SENS-ECAT-M8"
    assert found["check_byte_right"]
    assert found["mailboxes"] == {"out": [0x1000, 128], "in": [0x1080, 128]}
    assert found["protocols"] == ["CoE", "FoE"]
    managers = [(row["start"], row["size"], row["kind"]) for row in found["sync_managers"]]
    assert managers[2:] == [(0x1100, 1, "outputs"), (0x1180, 61, "inputs")]
    assert found["fmmus"] == [1, 2, 3]


def test_every_object_is_read_and_decoded(bench: SimulatedBus) -> None:
    found = told("objects", bench.near)["sensors"][0]
    assert (found["name"], found["serial"]) == ("BFT-SENS-ECAT-M8", 4711)
    rows = {(int(row["index"], 16), row["subindex"]): row for row in found["objects"]}
    assert set(rows) == {row.address for row in KNOWN_OBJECTS}
    decoded: dict[tuple[int, int], dict[str, object]] = {
        (0x8011, 0): {"value": 100, "unit": "Hz"},
        (0x8004, 0): {"meaning": "±2 g"},
        (0x8006, 2): {"meaning": "FIR off"},
        (0x8006, 1): {"write_states": ["PREOP"], "allowed": {"from": 32, "to": 2048}},
        (0x6000, 4): {"value": 1.5},
    }
    for address, expected in decoded.items():
        assert expected.items() <= rows[address].items()
    assert rows[0x8004, 0]["allowed"]["3"] == "±16 g"
    assert "0x06020000" in rows[0x8003, 0]["error"]
    quaternion = {(0x6000, sub) for sub in range(0x14, 0x18)}
    assert {address for address, row in rows.items() if "error" in row} == {(0x8003, 0)} | quaternion


def test_objects_that_cannot_be_read_have_a_line_with_the_reason(
    bench: SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    near = bench.near
    fewer_objects(monkeypatch)
    bench.command("abort 0x8002 1 0x08000021")
    lines = tool_here("objects", near).out.splitlines()
    missing = next(line for line in lines if "0x8010:4" in line)
    assert "this firmware does not have it (abort 0x06090011)" in missing
    assert "refused" in next(line for line in lines if "0x8002:1" in line)
    assert any("Sampling rate" in line and "100" in line for line in lines)
    alone = tool_here("read", near, "0x8010:4", code=1)
    assert "this firmware does not have it" in alone.out + alone.err


def test_an_eeprom_that_cannot_be_read_says_so(bench: SimulatedBus) -> None:
    bench.command("sii error")
    said = refused("eeprom", bench.near)
    assert "the SII of slave 0 cannot be read at word 0x0000: it refuses" in said
    assert "cannot be read" in refused("objects", bench.near)
    bench.command("sii ok")
    assert told("eeprom", bench.near)["slaves"][0]["check_byte_right"]


def test_objects_of_a_chain_by_place_serial_and_name(models: SimulatedBus) -> None:
    sensors = told("objects", models.near)["sensors"]
    assert len(sensors) == 2
    assert not [row for row in sensors[1]["objects"] if row["index"] == "0x6000" and "error" in row]
    for which in ("1", "20", "serial:20", "BFT-ROKS-ECAT-M8"):
        read = tool_here("read", models.near, "Sampling rate", "--sensor", which, "--json")
        assert [row["serial"] for row in read.json["sensors"]] == [20]
    assert "no sensor matches" in refused("objects", models.near, "--sensor", "7", code=2)


def test_a_bus_that_is_silent_is_one_sentence(bench: SimulatedBus) -> None:
    bench.command("deaf")
    for command in ("eeprom", "objects", "save"):
        assert "no EtherCAT slave answers on " in refused(command, bench.near)


SII_ACCESS = set(range(reg.SII_OWNER, reg.SII_OWNER + 8))
"""Registers that are written to read an SII; its owner gets it back."""


@pytest.mark.parametrize("command", [("objects",), ("snapshot", "new"), ("apply", "--set", "chop=on")])
def test_a_bus_without_a_sensor_is_not_touched(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with simulated_bus("--chain", "EK1100,DRIVE:PREOP") as bus:
        assert "no Bota Gen-0 sensor" in refused(command[0], bus.near, *command[1:])
        for slave in bus.backend.sensors.slaves:
            assert isinstance(slave, ForeignSlave)
            assert {address for address, _ in slave.writes} <= SII_ACCESS
        assert [row["name"] for row in told("eeprom", bus.near)["slaves"]] == ["EK1100", "DRIVE"]


@pytest.mark.parametrize(
    ("command", "option"),
    [(("eeprom",), "--force"), (("tare",), "--force"), (("snapshot", "new"), "--take-over")],
)
def test_a_drive_at_work_is_not_touched(
    command: tuple[str, ...], option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with simulated_bus("--chain", "BOTA:OP,DRIVE:OP") as bus:
        before = registers(bus.backend)
        said = refused(command[0], bus.near, *command[1:])
        assert "has slaves at work that are not Bota sensors (position 1 in OP)" in said
        assert f"; {option} takes them to PREOP" in said
        assert registers(bus.backend) == before
        assert bus.stats_of_foreign(1)["write_count"] == 0


FORCE = (1.5, -2.25, -9.75)
SERVER = ("--server", SimulatedServer.address)
FORCE_Z = "0x6000:6"


def unsettled_at_first(bus: SimulatedBus) -> None:
    """The sensor gives a wrong force for the first 0.4 s in OP, from now on."""
    state = ""

    def look() -> None:
        nonlocal state
        before, state = state, bus.stats()["al_state"]
        if state == "OP" != before:
            bus.command("limit force.z 5")
            bus.at(0.4, "limit force.z off")
        bus.at(0.001, look)

    look()


@pytest.mark.parametrize("command", ["tare", "read"])
def test_through_a_server_that_has_just_started(single: SimulatedBus, command: str) -> None:
    unsettled_at_first(single)
    with simulated_server(single):
        if command == "tare":
            shown = -told("tare", *SERVER, "--samples", 20)["new_offset"][2]
        else:
            read = told("read", FORCE_Z, *SERVER)["sensors"][0]["objects"]
            shown = read[0]["value"]
    assert shown == FORCE[2]
