"""`eeprom`, `objects`, `read` and `watch` without a server, on simulated sensors."""

from __future__ import annotations

import json
import re
import signal
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from ethercat_server.ethercat.slave import registers as reg
from ethercat_server.ethercat.wire import DATAGRAM_HEADER, FRAME_HEADER, Command
from ethercat_server.sensor.objects.search import KNOWN_OBJECTS, NOTE_NAMES
from ethercat_server.simulation.backend import MemoryBackend
from ethercat_server.tool.cli import COMMANDS
from tests.simulated_links import registers, simulated_bus
from tests.simulation import SimulatedBus
from tests.tool.odd_firmware import FOREIGN_VENDOR, fewer_objects, foreign, no_mailbox
from tests.tool.running import complaints, one_sentence, tool_here


@pytest.fixture
def bench() -> Iterator[SimulatedBus]:
    """One sensor with 61 bytes of process data that gives the same numbers for ever."""
    with simulated_bus("--signal", "constant", "--serial", "4711") as bus:
        yield bus


@pytest.fixture
def chain() -> Iterator[SimulatedBus]:
    """Two with 77 bytes."""
    models = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
    with simulated_bus("--pdo", "77", "--model", models, "--serial", "10,20") as bus:
        yield bus


def test_eeprom_shows_the_words_and_what_they_mean(bench: SimulatedBus) -> None:
    shown = tool_here("eeprom", bench.near).out
    assert "\n0008: 7a|b0|00|00\n" in shown, "as the note's script prints it"
    assert "\n007e: " in shown
    found = tool_here("eeprom", bench.near, "--json").json["slaves"][0]
    assert (found["vendor"], found["product"], found["revision"], found["serial"]) == (0xB07A, 1, 3, 4711)
    assert found["name"] == "BFT-SENS-ECAT-M8"
    assert found["check_byte_right"]
    assert found["mailboxes"] == {"out": [0x1000, 128], "in": [0x1080, 128]}
    assert found["protocols"] == ["CoE", "FoE"]
    managers = [(row["start"], row["size"], row["kind"]) for row in found["sync_managers"]]
    assert managers[2:] == [(0x1100, 1, "outputs"), (0x1180, 61, "inputs")]
    assert found["fmmus"] == [1, 2, 3]


def test_eeprom_of_a_chain(chain: SimulatedBus) -> None:
    found = tool_here("eeprom", chain.near, "--json").json["slaves"]
    # Each slave's own name, though pysoem gives the second one the first one's.
    assert [row["name"] for row in found] == ["BFT-SENS-ECAT-M8", "BFT-ROKS-ECAT-M8"]
    assert [row["sync_managers"][3]["size"] for row in found] == [77, 77]
    only = tool_here("eeprom", chain.near, "--sensor", "20", "--json").json["slaves"]
    assert [row["sensor"] for row in only] == [1]


def test_every_object_is_read_and_decoded(bench: SimulatedBus) -> None:
    found = tool_here("objects", bench.near, "--json").json["sensors"][0]
    assert (found["name"], found["serial"]) == ("BFT-SENS-ECAT-M8", 4711)
    rows = {(int(row["index"], 16), row["subindex"]): row for row in found["objects"]}
    assert set(rows) == {row.address for row in KNOWN_OBJECTS}
    assert (rows[0x8011, 0]["value"], rows[0x8011, 0]["unit"]) == (800, "Hz")
    assert rows[0x8004, 0]["meaning"] == "±2 g"
    assert rows[0x8006, 2]["meaning"] == "FIR off"
    assert rows[0x8006, 1]["write_states"] == ["PREOP"]
    assert rows[0x8006, 1]["allowed"] == {"from": 32, "to": 2048}
    assert rows[0x8004, 0]["allowed"]["3"] == "±16 g"
    assert rows[0x6000, 4]["value"] == 1.5
    assert "0x06020000" in rows[0x8003, 0]["error"]
    unreadable = {address for address, row in rows.items() if "error" in row}
    assert unreadable == {(0x8003, 0)} | {(0x6000, sub) for sub in range(0x14, 0x18)}, (
        "61 bytes: no quaternion"
    )


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
    assert any("Sampling rate" in line and "800" in line for line in lines)
    alone = tool_here("read", near, "0x8010:4", code=1)
    assert "this firmware does not have it" in alone.out + alone.err


@pytest.mark.parametrize(("size", "missing"), [("61", 5), ("77", 1)])
def test_the_full_dump_has_a_line_for_every_object(size: str, missing: int) -> None:
    with simulated_bus("--pdo", size) as bus:
        lines = tool_here("objects", bus.near).out.splitlines()
    assert len(lines) == 2 + len(KNOWN_OBJECTS)
    assert sum("this firmware does not have it" in line for line in lines) == missing


def test_a_foreign_slave_is_no_sensor_to_anybody(monkeypatch: pytest.MonkeyPatch) -> None:
    foreign(monkeypatch)
    with simulated_bus() as bus:
        assert tool_here("eeprom", bus.near, "--json").json["slaves"][0]["vendor"] == FOREIGN_VENDOR
        assert "no Bota Gen-0 sensor" in one_sentence(tool_here("watch", bus.near, code=1))
        assert bus.written() == []


def test_a_sensor_without_a_mailbox_has_no_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    no_mailbox(monkeypatch)
    with simulated_bus() as bus:
        assert tool_here("eeprom", bus.near, "--json").json["slaves"][0]["protocols"] == []
        for command in (["objects"], ["plan", "--set", "fir=on"]):
            refused = tool_here(command[0], bus.near, *command[1:], code=1)
            assert "has no CoE mailbox" in one_sentence(refused)


def test_an_eeprom_that_cannot_be_read_says_so(bench: SimulatedBus) -> None:
    bench.command("sii error")
    said = one_sentence(tool_here("eeprom", bench.near, code=1))
    assert "the SII of slave 0 cannot be read at word 0x0000: it refuses" in said
    assert "cannot be read" in one_sentence(tool_here("objects", bench.near, code=1))
    bench.command("sii ok")
    assert tool_here("eeprom", bench.near, "--json").json["slaves"][0]["check_byte_right"]


def test_every_row_of_table_iii_1_is_read_by_name(bench: SimulatedBus) -> None:
    names = [name for _, _, name in NOTE_NAMES]
    ended = tool_here("read", bench.near, *names, "--json", code=1)
    found = ended.json["sensors"][0]["objects"]
    read = {(int(row["index"], 16), row["subindex"]) for row in found}
    assert {(index, subindex) for index, subindex, _ in NOTE_NAMES} <= read
    unreadable = {row["index"] for row in found if "error" in row}
    assert unreadable == {"0x8003", "0x6000"}, "no range, and no quaternion in 61 bytes"
    assert re.search(
        r"sensor 0 gave no value of .*: .*does not have it .*; and \d+ more$", one_sentence(ended)
    )


def test_a_sensor_that_sends_nothing_is_watched_in_vain() -> None:
    with simulated_bus("--sinc", "512") as bus:
        bus.at(0.6, "deaf 9")
        ended = tool_here("watch", bus.near, "--seconds", 3, "--interval", 9, code=1)
    assert "0 samples" in ended.out
    said = complaints(ended.err)[-1]
    assert said.endswith(
        "No new sample for 3.0 s, the sensor does not answer the bus: check its cable and power"
    )


def test_objects_of_a_chain_by_place_serial_and_name(chain: SimulatedBus) -> None:
    sensors = tool_here("objects", chain.near, "--json").json["sensors"]
    assert len(sensors) == 2
    assert not [row for row in sensors[1]["objects"] if row["index"] == "0x6000" and "error" in row]
    for which in ("1", "20", "serial:20", "BFT-ROKS-ECAT-M8"):
        read = tool_here("read", chain.near, "Sampling rate", "--sensor", which, "--json")
        assert [row["serial"] for row in read.json["sensors"]] == [20]
    assert "no sensor matches" in one_sentence(tool_here("objects", chain.near, "--sensor", "7", code=2))


def test_watch_shows_each_block_and_writes_nothing(bench: SimulatedBus) -> None:
    ended = tool_here("watch", bench.near, "--seconds", 0.6, "--interval", 0.2, code=1)
    assert "No new sample for 0.6 s, the sensor repeats the same sample" in one_sentence(ended)
    blocks = [line for line in ended.out.splitlines() if "samples" in line and line.startswith("sensor 0  ")]
    assert 2 <= len(blocks) <= 4
    assert "repeated" in blocks[1], "it gives nothing new, and shows"
    assert "F +1.500 -2.250 -9.750 N" in blocks[1]
    assert bench.written() == [], "it looks at the sensor as it is set"


def test_watch_gives_si_units_rate_and_warnings() -> None:
    with simulated_bus("--signal", "sine", "--pdo", "77", "--sinc", "128") as bus:
        bus.command("warn 0x20")
        ended = tool_here("watch", bus.near, "--samples", 200, "--interval", 10, "--json")
    (row,) = map(json.loads, ended.out.splitlines())
    assert row["samples"] == 200
    assert row["rate_hz"] == pytest.approx(400, rel=0.01), "as the sensor is set, not the server's default"
    assert row["acceleration"] == pytest.approx([0, 0, 9.80665])
    assert row["deviation"]["force"][0] > 0.3, "a fifth of a sine of 10 N"
    assert row["temperature"] == 35
    assert row["warnings"][0]["meaning"] == "Overtemperature"


def test_watch_counts_the_samples_that_the_bus_lost(chain: SimulatedBus) -> None:
    chain.at(1.2, "deaf 0.02")
    ended = tool_here("watch", chain.near, "--seconds", 0.9, "--interval", 10, "--json")
    assert [json.loads(line)["gaps"] for line in ended.out.splitlines()] == [1, 1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_the_normal_end_of_watch(chain: SimulatedBus, number: signal.Signals) -> None:
    chain.at(0.7, lambda: signal.raise_signal(number))
    ended = tool_here("watch", chain.near, "--interval", 0.1)
    assert complaints(ended.err) == []
    assert "sensor 1: " in ended.out.splitlines()[-1]


def test_a_bus_that_is_silent_is_one_sentence(bench: SimulatedBus) -> None:
    bench.command("deaf")
    for command in ("eeprom", "objects", "watch", "save"):
        assert "no EtherCAT slave answers on " in one_sentence(tool_here(command, bench.near, code=1))


FURTHER: dict[str, list[object]] = {
    "read": ["sampling rate"], "snapshot": ["new"], "restore": ["old"],
    "plan": ["--set", "chop=on"], "apply": ["--set", "chop=on"],
}  # fmt: skip
"""Arguments of commands on a bus of others."""
SII_ACCESS = set(range(reg.SII_OWNER, reg.SII_OWNER + 8))
"""Registers that are written to read an SII; its owner gets it back."""


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("adapters", "find", "eeprom")])
def test_a_bus_without_a_sensor_is_not_touched_by(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with simulated_bus() as bus:
        tool_here("snapshot", bus.near, "old")
    with simulated_bus("--chain", "EK1100,DRIVE:PREOP") as bus:
        before, sent = [state(each) for each in registers(bus.backend)], writes(bus.backend)
        result = tool_here(command, bus.near, *FURTHER.get(command, []), code=1)
        assert "no Bota Gen-0 sensor" in one_sentence(result)
        assert [state(each) for each in registers(bus.backend)] == before
        assert {address for _, address in sent} <= SII_ACCESS


def test_the_standard_objects_of_a_foreign_slave_in_the_state_it_is_in() -> None:
    with simulated_bus("--chain", "EK1100,DRIVE:PREOP,DRIVE") as bus:
        before, sent = [state(each) for each in registers(bus.backend)], writes(bus.backend)
        (slave,) = tool_here("objects", bus.near, "--slave", "1:DRIVE", "--json").json["sensors"]
        assert (slave["slave"], slave["name"]) == (1, "DRIVE")
        found = {(row["index"], row["subindex"]): row.get("value") for row in slave["objects"]}
        assert (found["0x1018", 1], found["0x1018", 2]) == (0x7E57, 402)
        assert [state(each) for each in registers(bus.backend)] == before
        assert len({address for _, address in sent} - SII_ACCESS) == 1, "its mailbox"
        for wanted, why in (
            ("1", "there are 0:EK1100; 1:DRIVE; 2:DRIVE"), ("0:DRIVE", "no slave is '0:DRIVE'"),
            ("0:EK1100", "has no CoE mailbox"),
        ):  # fmt: skip
            assert why in one_sentence(tool_here("objects", bus.near, "--slave", wanted, code=2))
        assert "is in INIT" in one_sentence(tool_here("objects", bus.near, "--slave", "2:DRIVE", code=1))


def state(registers: bytes) -> bytes:
    """What its own master has set up: station address, AL state, FMMUs, sync managers' layout."""
    managers = registers[reg.SYNC_MANAGER : reg.SYNC_MANAGER + 4 * reg.SYNC_MANAGER_SIZE]
    layout = b"".join(managers[at : at + 5] for at in range(0, len(managers), reg.SYNC_MANAGER_SIZE))
    return (
        registers[0x10:0x12]
        + registers[reg.AL_STATUS : reg.AL_STATUS + 1]
        + registers[reg.FMMU : reg.FMMU + 64]
        + layout
    )


def writes(backend: MemoryBackend) -> list[tuple[Command, int]]:
    """Filled with every datagram from now on that is not a read: command and register."""
    found: list[tuple[Command, int]] = []
    send = backend.send

    def note(frame: bytes | bytearray) -> None:
        at, more = FRAME_HEADER, True
        while more:
            command, _, _, address, length = struct.unpack_from("<BBHHH", frame, at)
            if command not in (Command.APRD, Command.FPRD, Command.BRD):
                found.append((Command(command), address))
            at += DATAGRAM_HEADER + (length & 0x7FF) + 2
            more = bool(length & 0x8000)
        send(frame)

    backend.send = note  # type: ignore[method-assign]
    return found


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("adapters", "find")])
def test_a_drive_at_work_is_not_touched_by(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with simulated_bus() as bus:
        tool_here("snapshot", bus.near, "old")
    with simulated_bus("--chain", "BOTA:OP,DRIVE:OP") as bus:
        before = registers(bus.backend)
        result = tool_here(command, bus.near, *FURTHER.get(command, []), code=1)
        assert "has slaves at work that are no Bota sensors (position 1 in OP)" in one_sentence(result)
        option = "--take-over" if command in {"snapshot", "restore"} else "--force"
        assert f"; {option} takes them to PREOP" in one_sentence(result)
        assert registers(bus.backend) == before
        assert bus.stats_of_foreign(1)["write_count"] == 0
