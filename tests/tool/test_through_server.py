"""The same through a running server: named with --server, or found because it holds the interface."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ended import run
from tests.server.commands import command, stats, written
from tests.server.running import (
    PATIENCE_S,
    Program,
    Server,
    Veth,
    needs_bus,
    server,
    virtual_sensor,
    wait_until,
)
from tests.server.steady import steady_bench, steady_sensor
from tests.tool.running import MODULE, one_sentence, tool

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, Program, Server]


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    with (
        virtual_sensor("--sensors", "2", "--serial", "10,20", "--pdo", "77", "--signal", "rest") as (
            veth,
            sensor,
        ),
        server(veth.near, "--rt-priority", "0") as running,
    ):
        yield veth, sensor, running
        assert stats(sensor)["calibration_writes"] == 0
        assert running.process.poll() is None


def address(running: Server) -> tuple[str, str]:
    return "--server", f"localhost:{running.port}"


def test_a_server_that_holds_the_interface_is_found_and_said(bench: Bench) -> None:
    veth, _, running = bench
    ended = tool("objects", veth.near, "--sensor", 0, "--json")
    used = f"the server at 127.0.0.1:{running.port}, process {running.process.pid}"
    assert used in one_sentence(ended)
    assert used in ended.json["through"]
    held = {row["name"]: row["held_by"] for row in tool("adapters", "--json").json["adapters"]}
    assert f"process {running.process.pid}" in held[veth.near]


def test_a_master_that_is_no_server_is_named(bench: Bench) -> None:
    veth, sensor, _ = bench
    said = one_sentence(tool("objects", veth.far, code=1))
    assert f"{veth.far} is in use by process {sensor.process.pid}" in said


def test_the_eeprom_is_read_while_the_server_streams(bench: Bench) -> None:
    veth, _, running = bench
    with running.connect() as client:
        before = client.ask("status")
        found = tool("eeprom", *address(running), "--json").json["slaves"]
        assert [(row["serial"], row["check_byte_right"]) for row in found] == [(10, True), (20, True)]
        assert [row["name"] for row in found] == ["BFT-SENS-ECAT-M8"] * 2
        assert [row["sync_managers"][3]["size"] for row in found] == [77, 77]
        only = tool("eeprom", veth.near, "--sensor", "20")
        assert f"process {running.process.pid}" in one_sentence(only)
        assert "\n000e: 14|00|00|00\n" in only.out
        after = client.ask("status")
        was, now = ([row["recoveries"] for row in status["sensors"]] for status in (before, after))
        assert now == was or after["lost_frames"] > before["lost_frames"], "or it was starved"


def test_objects_are_read_by_name(bench: Bench) -> None:
    _, _, running = bench
    found = tool("read", *address(running), "Sampling Rate", "Force/Torque Offset", "--json").json["sensors"]
    assert [row["serial"] for row in found] == [10, 20]
    rows = [(row["index"], row["subindex"]) for row in found[0]["objects"]]
    assert rows == [("0x8011", 0), *(("0x8000", sub) for sub in range(7))]
    assert "did you mean Sampling rate" in one_sentence(
        tool("read", *address(running), "sampling rte", code=2)
    )


def test_objects_and_watch(bench: Bench) -> None:
    _, _, running = bench
    sensors = tool("objects", *address(running), "--json").json["sensors"]
    assert [row["serial"] for row in sensors] == [10, 20]
    rates = [row["value"] for row in sensors[1]["objects"] if row["index"] == "0x8011"]
    assert rates == [800]
    ended = tool("watch", *address(running), "--samples", 100, "--interval", 20, "--json")
    rows = [json.loads(line) for line in ended.out.splitlines()]
    assert [(row["sensor"], row["samples"]) for row in rows] == [(0, 100), (1, 100)]
    assert len(rows[0]["force"]) == 3
    assert "sensor 1: " in tool("watch", *address(running), "--sensor", 20, "--seconds", 0.2).out


def test_plan_apply_save(bench: Bench) -> None:
    _, sensor, running = bench
    asked = ("--sensor", "20", "--set", "sinc_length=128", *address(running))
    assert tool("plan", *asked, "--json", code=3).json["changes"][0]["then"] == 128
    applied = tool("apply", *asked, "--json").json
    assert (applied["rate_hz"], applied["settings"]["sinc_length"]) == (400, 128)
    assert "nothing to change" in tool("plan", *asked).out
    tool("save", "--sensor", 1, *address(running))
    assert ("0x8030", 1, "01") in written(sensor, 1)
    with running.connect() as client:
        assert [row["rate_hz"] for row in client.ask("describe")["sensors"]] == [800, 400]


def test_apply_that_fails_half_way_takes_everything_back() -> None:
    with (
        virtual_sensor(module="tests.server.odd_sensor", first=("refusing",)) as (veth, sensor),
        server(veth.near) as running,
    ):
        asked = ("--set", "sinc_length=128", "--set", "fir=on", *address(running))
        said = one_sentence(tool("apply", *asked, code=1))
        assert "the former settings are in force" in said
        assert ("0x8006", 2, "00") in written(sensor), "FIR had been switched on"
        assert len(tool("plan", *asked, "--json", code=3).json["changes"]) == 2


def test_what_the_sensor_lacks_or_contradicts_itself_changes_nothing(bench: Bench) -> None:
    _, sensor, running = bench
    with running.connect() as client:
        before = client.ask("describe")["sensors"][0]["settings"]
        asked = ("--sensor", 0, *address(running), "--set", "temperature_compensation=on")
        command(sensor, "abort 0x8010 4 0x06020000")
        missing = tool("apply", *asked, "--set", "coordinate_system=on", code=1)
        assert "has no setting coordinate_system" in one_sentence(missing)
        assert client.ask("describe")["sensors"][0]["settings"] == before
    refused = tool("apply", *asked, "--set", "fast=on", code=2)
    assert "fast is true but fir is false" in one_sentence(refused)


def test_tare(bench: Bench) -> None:
    _, sensor, running = bench
    tared = tool("tare", "--sensor", 0, "--samples", 50, *address(running), "--json").json
    assert len(tared["new_offset"]) == 6
    assert {row[0] for row in written(sensor)} == {"0x8000"}


def test_a_tare_that_is_stopped_tells_what_came_of_it() -> None:
    with steady_sensor() as sensor, steady_bench(sensor) as bench:
        command = [
            sys.executable,
            "-m",
            MODULE,
            "tare",
            "--samples",
            "2000",
            "--json",
            *address(bench.running),
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as taring:

            def under_way() -> bool:
                # Contradictory settings change nothing: refused as they are, or as busy.
                refused = bench.asking.ask("configure", settings={"fir": False, "fast": True})
                return bool(refused["error"]["code"] == "busy")

            wait_until(under_way, "the tare")
            taring.send_signal(signal.SIGINT)
            out, err = taring.communicate(timeout=PATIENCE_S)
        assert "tares on: waiting for what comes of it" in err
        assert taring.returncode == 0, err
        held = bench.asking.ask("sdo_read", index=0x8000, subindex=1, type="f32")["value"]
        assert json.loads(out)["new_offset"][0] == held == -1.5


def test_a_sensor_that_is_out_does_not_hide_the_other() -> None:
    with steady_sensor("--signal rest --sensors 2 --serial 10,20") as sensor, steady_bench(sensor) as bench:
        where = address(bench.running)
        sensor.command("power off @1")
        bench.wait_event("sensor_lost")
        assert tool("eeprom", *where, "--sensor", 0, "--json").json["slaves"][0]["serial"] == 10
        assert tool("eeprom", *where, "--sensor", 10).code == 0
        for words, key in ((("eeprom",), "slaves"), (("read", "Force/Torque Offset"), "sensors")):
            shown = run(MODULE, *words, *where)
            assert shown.code == 1
            assert "sensor 1 is lost" in shown.err
            found = run(MODULE, *words, *where, "--json").json[key]
            assert ("error" in found[0], "error" in found[1]) == (False, True)
            assert found[0]["serial"] == 10


def test_snapshot_and_restore(bench: Bench, tmp_path: Path) -> None:
    _, sensor, running = bench
    path = tmp_path / "a.json"
    tool("snapshot", path, "--sensor", 0, *address(running))
    tool("apply", "--sensor", 0, *address(running), "--set", "chop=on")
    content = json.loads(path.read_text())
    for row in content["objects"]:
        if row["index"] == "0x8000" and row["subindex"] == 2:
            row["hex"] = "0000803f"
    path.write_text(json.dumps(content))
    assert "serial 20" in one_sentence(tool("restore", path, "--sensor", 1, *address(running), code=1))
    restored = tool("restore", *address(running), path, "--sensor", 0, "--json").json
    assert [(row["name"], row["then"]) for row in restored["changes"]] == [("chop", False)]
    assert [(row["index"], row["subindex"]) for row in restored["objects"]] == [("0x8000", 2)]
    assert ("0x8000", 2, "0000803f") in written(sensor)


@pytest.mark.parametrize("where", ["localhost:1", "[::1]:1"])
def test_a_port_where_no_server_is(bench: Bench, where: str) -> None:
    said = one_sentence(tool("objects", "--server", where, "--json", code=1))
    assert f"no server answers at {where} " in said
