"""`adapters`, `eeprom`, `objects` and `watch` on real frames, without a server."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from ethercat_server.known_objects import KNOWN_OBJECTS
from ethercat_server.object_names import NOTE_NAMES
from tests.server.commands import command, stats, written
from tests.server.odd_sensor import FOREIGN_LACKS
from tests.server.running import Program, Veth, needs_bus, virtual_sensor, wait_until
from tests.tool.running import MODULE, complaints, one_sentence, tool

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, Program]


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """One sensor with 61 bytes of process data that gives the same numbers for ever."""
    with virtual_sensor("--signal", "constant", "--serial", "4711") as (veth, sensor):
        yield veth, sensor


@pytest.fixture(scope="module")
def chain() -> Iterator[Bench]:
    """Two with 77 bytes."""
    models = "BFT-SENS-ECAT-M8,BFT-ROKS-ECAT-M8"
    with virtual_sensor("--pdo", "77", "--model", models, "--serial", "10,20") as (veth, sensor):
        yield veth, sensor


def test_adapters_say_what_state_they_are_in(bench: Bench) -> None:
    veth, sensor = bench
    found = {row["name"]: row for row in tool("adapters", "--json").json["adapters"]}
    near, far = found[veth.near], found[veth.far]
    assert (near["up"], near["carrier"], near["held_by"]) == (True, True, None)
    assert f"process {sensor.process.pid}" in far["held_by"]
    assert found["lo"]["loopback"]
    line = next(line for line in tool("adapters").out.splitlines() if line.startswith(veth.near))
    assert "up" in line


def test_eeprom_shows_the_words_and_what_they_mean(bench: Bench) -> None:
    shown = tool("eeprom", bench[0].near).out
    assert "\n0008: 7a|b0|00|00\n" in shown, "as the note's script prints it"
    assert "\n007e: " in shown
    found = tool("eeprom", bench[0].near, "--json").json["slaves"][0]
    assert (found["vendor"], found["product"], found["revision"], found["serial"]) == (0xB07A, 1, 3, 4711)
    assert found["name"] == "BFT-SENS-ECAT-M8"
    assert found["check_byte_right"]
    assert found["mailboxes"] == {"out": [0x1000, 128], "in": [0x1080, 128]}
    assert found["protocols"] == ["CoE", "FoE"]
    managers = [(row["start"], row["size"], row["kind"]) for row in found["sync_managers"]]
    assert managers[2:] == [(0x1100, 1, "outputs"), (0x1180, 61, "inputs")]
    assert found["fmmus"] == [1, 2, 3]


def test_eeprom_of_a_chain(chain: Bench) -> None:
    found = tool("eeprom", chain[0].near, "--json").json["slaves"]
    # Each slave's own name, though pysoem gives the second one the first one's.
    assert [row["name"] for row in found] == ["BFT-SENS-ECAT-M8", "BFT-ROKS-ECAT-M8"]
    assert [row["sync_managers"][3]["size"] for row in found] == [77, 77]
    only = tool("eeprom", chain[0].near, "--sensor", "20", "--json").json["slaves"]
    assert [row["sensor"] for row in only] == [1]


def test_every_object_is_read_and_decoded(bench: Bench) -> None:
    found = tool("objects", bench[0].near, "--json").json["sensors"][0]
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


def test_objects_that_cannot_be_read_have_a_line_with_the_reason(bench: Bench) -> None:
    veth, sensor = bench
    command(sensor, "abort 0x8010 4 0x06020000")
    command(sensor, "abort 0x8002 1 0x08000021")
    lines = tool("objects", veth.near).out.splitlines()
    missing = next(line for line in lines if "0x8010:4" in line)
    assert "this firmware does not have it (abort 0x06020000)" in missing
    assert "refused" in next(line for line in lines if "0x8002:1" in line)
    assert any("Sampling rate" in line and "800" in line for line in lines)


@pytest.mark.parametrize(("size", "missing"), [("61", 5), ("77", 1)])
def test_the_full_dump_has_a_line_for_every_object(size: str, missing: int) -> None:
    with virtual_sensor("--pdo", size) as (veth, _):
        lines = tool("objects", veth.near).out.splitlines()
    assert len(lines) == 2 + len(KNOWN_OBJECTS)
    assert sum("this firmware does not have it" in line for line in lines) == missing


def test_a_foreign_slave_is_dumped_as_far_as_it_goes() -> None:
    with virtual_sensor(module="tests.server.odd_sensor", first=("foreign",)) as (veth, sensor):
        rows = tool("objects", veth.near, "--json").json["sensors"][0]["objects"]
        lacking = {int(row["index"], 16) for row in rows if "error" in row}
        assert lacking >= FOREIGN_LACKS
        assert [row["value"] for row in rows if row["index"] == "0x8011"] == [800]
        lines = tool("objects", veth.near).out.splitlines()
        assert len(lines) == 2 + len(KNOWN_OBJECTS)
        assert "800" in tool("read", veth.near, "sampling rate").out
        assert tool("eeprom", veth.near, "--json").json["slaves"][0]["vendor"] == 0xDEAD
        assert "not a Bota Gen-0 sensor" in one_sentence(tool("watch", veth.near, code=1))
        assert written(sensor) == []


def test_a_slave_without_a_mailbox_has_no_objects() -> None:
    with virtual_sensor(module="tests.server.odd_sensor", first=("mailbox",)) as (veth, _):
        assert "it has no CoE mailbox, and so no objects" in tool("objects", veth.near).out
        assert tool("eeprom", veth.near, "--json").json["slaves"][0]["protocols"] == []
        assert "has no CoE mailbox" in one_sentence(tool("plan", veth.near, "--set", "fir=on", code=1))


def test_an_eeprom_that_cannot_be_read_says_so() -> None:
    with virtual_sensor() as (veth, sensor):
        command(sensor, "sii error")
        said = one_sentence(tool("eeprom", veth.near, code=1))
        assert "the SII of slave 0 cannot be read at word 0x0000: it refuses" in said
        assert "cannot be read" in one_sentence(tool("objects", veth.near, code=1))
        command(sensor, "sii ok")
        assert tool("eeprom", veth.near, "--json").json["slaves"][0]["check_byte_right"]


def test_every_row_of_table_iii_1_is_read_by_name(bench: Bench) -> None:
    names = [name for _, _, name in NOTE_NAMES]
    found = tool("read", bench[0].near, *names, "--json").json["sensors"][0]["objects"]
    read = {(int(row["index"], 16), row["subindex"]) for row in found}
    assert {(index, subindex) for index, subindex, _ in NOTE_NAMES} <= read
    unreadable = {row["index"] for row in found if "error" in row}
    assert unreadable == {"0x8003", "0x6000"}, "no range, and no quaternion in 61 bytes"


def test_objects_of_a_chain_by_place_serial_and_name(chain: Bench) -> None:
    assert len(tool("objects", chain[0].near, "--json").json["sensors"]) == 2
    for which in ("1", "20", "serial:20", "BFT-ROKS-ECAT-M8"):
        sensors = tool("objects", chain[0].near, "--sensor", which, "--json").json["sensors"]
        assert [row["serial"] for row in sensors] == [20]
        assert not [row for row in sensors[0]["objects"] if row["index"] == "0x6000" and "error" in row]
    assert "is no sensor" in one_sentence(tool("objects", chain[0].near, "--sensor", "7", code=2))


def test_watch_shows_each_block_and_writes_nothing(bench: Bench) -> None:
    veth, sensor = bench
    before = written(sensor)
    ended = tool("watch", veth.near, "--seconds", 0.6, "--interval", 0.2)
    blocks = [line for line in ended.out.splitlines() if "samples" in line and line.startswith("sensor 0  ")]
    assert 2 <= len(blocks) <= 4
    assert "repeated" in blocks[1], "it gives nothing new, and shows"
    assert "F +1.500 -2.250 -9.750 N" in blocks[1]
    assert written(sensor) == before, "it looks at the sensor as it is set"


def test_watch_gives_si_units_rate_and_warnings() -> None:
    with virtual_sensor("--signal", "sine", "--pdo", "77", "--sinc", "128") as (veth, sensor):
        command(sensor, "warn 0x20")
        lines = tool("watch", veth.near, "--samples", 200, "--interval", 10, "--json").out.splitlines()
    (row,) = map(json.loads, lines)
    assert row["samples"] == 200
    assert row["rate_hz"] == pytest.approx(400, rel=0.05), "as the sensor is set, not the server's default"
    assert row["acceleration"] == pytest.approx([0, 0, 9.80665])
    assert row["deviation"]["force"][0] > 0.3, "a fifth of a sine of 10 N"
    assert row["temperature"] == 35
    assert row["warnings"][0]["meaning"] == "Overtemperature"


def test_watch_ends_with_ctrl_c_and_leaves_the_bus(chain: Bench) -> None:
    veth, sensor = chain
    watching = subprocess.Popen(
        [sys.executable, "-m", MODULE, "watch", veth.near, "--interval", "0.1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert watching.stdout is not None
    while "samples" not in watching.stdout.readline():
        pass
    watching.send_signal(signal.SIGINT)
    out, err = watching.communicate(timeout=10)
    assert (watching.returncode, complaints(err)) == (0, [])
    assert "sensor 1: " in out.splitlines()[-1]
    wait_until(lambda: stats(sensor)["al_state"] == "INIT", "INIT")
