"""`plan`, `apply`, `save`, `tare`, `snapshot` and `restore` on real frames, without a server."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.filters import FORCE_TORQUE_FILTERS
from tests.ended import run
from tests.server.commands import command, stats, written
from tests.server.running import Program, Veth, needs_bus, virtual_sensor, wait_until
from tests.tool.running import MODULE, complaints, one_sentence, tool

pytestmark = [pytest.mark.bus, needs_bus]
Bench = tuple[Veth, Program]
ODD = str(Path(__file__).parent.parent / "server" / "odd_sensor.py")


@pytest.fixture(params=["61", "77"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A fresh sensor; whatever was done to it, nobody wrote its factory calibration."""
    with virtual_sensor("--pdo", request.param, "--signal", "rest", "--serial", "4711") as (veth, sensor):
        yield veth, sensor
        assert stats(sensor)["calibration_writes"] == 0


@pytest.fixture
def chain() -> Iterator[Bench]:
    with virtual_sensor("--sensors", "2", "--serial", "10,20") as (veth, sensor):
        yield veth, sensor
        assert [stats(sensor, place)["calibration_writes"] for place in (0, 1)] == [0, 0]


@pytest.fixture
def odd(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """A sensor that is odd in the way of the fixture's parameter."""
    with virtual_sensor(module="tests.server.odd_sensor", first=(request.param,)) as (veth, sensor):
        yield veth, sensor


def test_plan_says_what_would_change_and_writes_nothing(bench: Bench) -> None:
    veth, sensor = bench
    asked = ("--set", "sinc_length=128", "--set", "fir=on", "--set", "imu_active=1")
    shown = tool("plan", veth.near, *asked, code=3).out
    assert "sinc_length  64     128   400 Hz; cut-off 105 Hz with FIR off, 16 Hz with FIR on" in shown
    assert "cut-off 16 Hz, added delay not in the table" in shown
    found = tool("plan", veth.near, *asked, "--json", code=3).json
    assert [(row["name"], row["now"], row["then"]) for row in found["changes"]] == [
        ("fir", False, True),
        ("sinc_length", 64, 128),
    ]
    assert (found["now"]["cutoff_hz"], found["then"]["cutoff_hz"]) == (209.5, 16.0)
    assert tool("plan", veth.near, "--set", "sinc_length=64", "--json").json["changes"] == []
    assert written(sensor) == []


def test_apply_does_what_plan_says_and_a_file_says_it_too(bench: Bench, tmp_path: Path) -> None:
    veth, sensor = bench
    config = tmp_path / "sensor.toml"
    config.write_text("[sensor]\nsinc_length = 205\nacceleration_range_g = 8\n[sensor.0]\nchop = true\n")
    applied = tool("apply", veth.near, "--config", config, "--json").json
    assert (applied["rate_hz"], applied["saved"]) == (250, False)
    assert {"sinc_length": 205, "acceleration_range_g": 8, "chop": True, "fir": False}.items() <= applied[
        "settings"
    ].items()
    again = tool("apply", veth.near, "--config", config)
    assert "nothing to change" in again.out
    assert tool("plan", veth.near, "--config", config).code == 0
    command(sensor, "power cycle 0.1")
    assert tool("plan", veth.near, "--config", config, code=3), "it was not saved"
    config.write_text("[sensor]\nsinc_length = 205\n[sensor.7]\nfir = true\n")
    for name in ("plan", "apply"):
        said = one_sentence(tool(name, veth.near, "--config", config, code=2))
        assert "has settings for sensor 7, but the bus has only 0: BFT-SENS-ECAT-M8 with serial 4711" in said


def test_apply_and_save_keep_it_over_a_power_cut(bench: Bench) -> None:
    veth, sensor = bench
    tool("apply", veth.near, "--set", "sinc_length=256", "--save")
    tool("apply", veth.near, "--set", "temperature_compensation=true")
    tool("save", veth.near)
    assert written(sensor).count(("0x8030", 1, "01")) == 2
    command(sensor, "power cycle 0.1")
    asked = ("--set", "sinc_length=256", "--set", "temperature_compensation=true")
    assert "nothing to change" in tool("plan", veth.near, *asked).out


def test_a_power_cut_in_the_save_says_what_holds(bench: Bench) -> None:
    veth, sensor = bench
    command(sensor, "cut-save 5")
    said = one_sentence(tool("apply", veth.near, "--set", "fir=true", "--save", code=1))
    assert said.endswith("; whether it saved all, some or none of its settings is not known: save again")


def test_every_sinc_length_of_the_table_gives_its_rate(chain: Bench) -> None:
    for length, row in FORCE_TORQUE_FILTERS.items():
        applied = tool(
            "apply", chain[0].near, "--sensor", 20, "--set", f"sinc_length={length}", "--json"
        ).json
        assert applied["rate_hz"] == row.rate_hz
        assert applied["meaning"]["cutoff_hz"] == row.cutoff_fir_off_hz
    assert written(chain[1], 0) == [], "the other sensor of the chain"


def test_a_chain_wants_a_choice(chain: Bench) -> None:
    near = chain[0].near
    said = one_sentence(tool("apply", near, "--set", "fir=on", code=2))
    assert "choose one with --sensor" in said
    assert "serial 20" in said
    assert "is 2 sensors of those here" in one_sentence(
        tool("save", near, "--sensor", "BFT-SENS-ECAT-M8", code=2)
    )
    assert written(chain[1]) == []


@pytest.mark.parametrize("odd", ["refusing"], indirect=True)
def test_apply_that_fails_half_way_takes_everything_back(odd: Bench, tmp_path: Path) -> None:
    veth, sensor = odd
    asked = ("--set", "sinc_length=128", "--set", "fir=on", "--set", "imu_active=3")
    failed = tool("apply", veth.near, *asked, "--json", code=1)
    assert "sinc_length = 128 did not take" in failed.json["error"]
    assert "the former settings are in force" in one_sentence(failed)
    assert ("0x8006", 2, "00") in written(sensor), "FIR had been switched on"
    assert len(tool("plan", veth.near, *asked, "--json", code=3).json["changes"]) == 3
    # The same of a snapshot whose settings take, but not its last offsets.
    path = tmp_path / "a.json"
    tool("snapshot", veth.near, path)
    content = json.loads(path.read_text())
    content["settings"]["imu_active"] = 3
    for row in content["objects"]:
        if row["index"] == "0x8000" and row["subindex"] in {1, 5}:
            row["hex"] = "0000003f"
    path.write_text(json.dumps(content))
    assert "the former settings are in force" in one_sentence(tool("restore", veth.near, path, code=1))
    assert ("0x8000", 1, "0000003f") in written(sensor)
    assert len(tool("plan", veth.near, *asked, "--json", code=3).json["changes"]) == 3
    rows = tool("objects", veth.near, "--json").json["sensors"][0]["objects"]
    assert [row["value"] for row in rows if row["index"] == "0x8000"] == [6, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("odd", ["fewer"], indirect=True)
def test_settings_that_a_sensor_lacks_are_named(odd: Bench) -> None:
    near = odd[0].near
    said = one_sentence(tool("apply", near, "--set", "coordinate_system=on", "--set", "fir=on", code=1))
    assert "has no setting coordinate_system" in said
    assert "0x8010:4" in said
    assert written(odd[1]) == []
    assert tool("apply", near, "--set", "fir=on", "--json").json["settings"]["fir"] is True
    assert "0x8010:5" in tool("objects", near).out


@pytest.mark.parametrize("odd", ["rate"], indirect=True)
def test_a_sinc_length_is_verified_by_the_rate(odd: Bench) -> None:
    failed = tool("apply", odd[0].near, "--set", "sinc_length=128", code=1)
    assert "samples at 500 Hz" in one_sentence(failed)


def test_tare_makes_the_mean_the_target(bench: Bench) -> None:
    veth, sensor = bench
    target = ("1", "-2", "3", "0.1", "0.2", "-0.3")
    tared = tool("tare", veth.near, "--samples", 100, "--target", *target, "--json").json
    assert tared["old_offset"] == [0.0] * 6
    assert max(map(abs, tared["residual"])) < 1e-5
    rows = tool("objects", veth.near, "--json").json["sensors"][0]["objects"]
    held = [row["value"] for row in rows if row["index"] == "0x8000"][1:]
    assert held == pytest.approx(tared["new_offset"], rel=1e-5)
    assert {row[0] for row in written(sensor)} == {"0x8000"}, "nothing but the offset"


def test_a_sensor_that_moves_is_not_tared() -> None:
    with virtual_sensor("--signal", "sine") as (veth, sensor):
        assert "not at rest" in one_sentence(tool("tare", veth.near, "--samples", 50, code=1))
        assert written(sensor) == []


def test_a_slow_motion_during_a_tare_is_told() -> None:
    with virtual_sensor("--signal", "turn") as (veth, _):
        tared = tool("tare", veth.near, "--samples", 800)
        assert max(map(abs, tool("tare", veth.near, "--samples", 800, "--json").json["residual"][:3])) > 0.3
    assert re.search("the residual of F[xyz], -?[0-9.]+ N, is more than noise explains", tared.err)
    assert "old offset" in tared.out


def test_a_tare_that_is_stopped_changes_nothing() -> None:
    with virtual_sensor("--signal", "sine") as (veth, sensor):
        taring = subprocess.Popen(
            [sys.executable, "-m", MODULE, "tare", veth.near, "--samples", "20000"],
            stderr=subprocess.PIPE,
            text=True,
        )
        wait_until(lambda: stats(sensor)["al_state"] == "OP", "OP")
        time.sleep(0.1)
        taring.send_signal(signal.SIGTERM)
        _, err = taring.communicate(timeout=10)
        assert (taring.returncode, complaints(err)) == (1, ["ethercat-sensor: stopped before it was done"])
        assert written(sensor) == []


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("deaf 0.5", "; it is back, and its old offset is in force"),
        ("power cycle 0.3", "; it is back, and its old offset is in force"),
        ("deaf", "; its offset may be half written (it was -1.5 2.25 9.75 -0.125 0.0625 -0.03125): tare it"),
    ],
)
def test_a_tare_cut_off_half_way_leaves_the_old_offset_or_tells_it(fault: str, said: str) -> None:
    with virtual_sensor("--signal", "rest") as (veth, sensor):
        tool("tare", veth.near, "--samples", 20)
        command(sensor, f"on-write 0x8000 3 {fault}")
        target = ("1", "2", "3", "4", "5", "6")
        failed = run(MODULE, "tare", veth.near, "--samples", 20, "--target", *target)
        assert failed.code == 1
        assert said in failed.err.splitlines()[-1]
        if "force" in said:
            read = tool("read", veth.near, "Force/Torque Offset", "--json").json["sensors"][0]["objects"]
            assert [row["value"] for row in read[1:]] == [-1.5, 2.25, 9.75, -0.125, 0.0625, -0.03125]


def test_a_snapshot_is_restored_as_far_as_it_differs(bench: Bench, tmp_path: Path) -> None:
    veth, sensor = bench
    path = tmp_path / "a.json"
    tool("apply", veth.near, "--set", "sinc_length=341", "--set", "fir=on")
    assert tool("snapshot", veth.near, path, "--json").json["objects"] > 100
    content = json.loads(path.read_text())
    assert (content["model"], content["serial"], content["firmware"]) == ("BFT-SENS-ECAT-M8", 4711, "1.3.8")
    before = written(sensor)
    assert "nothing to restore" in tool("restore", veth.near, path).out
    assert written(sensor) == before
    command(sensor, "power cycle 0.1")
    for row in content["objects"]:
        if row["index"] in {"0x2000", "0x8001", "0x8030"} and row["subindex"] == 1:
            row["hex"] = row["hex"].replace("0", "1")
    path.write_text(json.dumps(content))
    restored = tool("restore", veth.near, path, "--save", "--json").json
    assert {row["name"] for row in restored["changes"]} == {"sinc_length", "fir"}
    assert [(row["index"], row["subindex"]) for row in restored["objects"]] == [("0x8001", 1)]
    later = written(sensor)
    assert {(index, sub) for index, sub, _ in later} == {
        ("0x8006", 1), ("0x8006", 2), ("0x8001", 1), ("0x8030", 1),
    }, "the command is the save's, and the factory calibration is left alone"  # fmt: skip
    assert later.count(("0x8030", 1, "01")) == 1
    assert "nothing to restore" in tool("restore", veth.near, path).out


def test_a_snapshot_follows_links_and_replaces_no_device(chain: Bench, tmp_path: Path) -> None:
    near, path, link, pipe = chain[0].near, tmp_path / "a.json", tmp_path / "link", tmp_path / "pipe"
    link.symlink_to(path)
    os.mkfifo(pipe)
    with open(pipe, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as reading:
        for file in (link, pipe):
            tool("snapshot", near, file, "--sensor", 0)
        assert json.load(reading)["serial"] == 10
    assert link.is_symlink()
    assert json.loads(path.read_text())["serial"] == 10
    assert pipe.is_fifo()
    assert '"serial": 10' in tool("snapshot", near, "/dev/stdout", "--sensor", 0).out
    failed = tool("snapshot", near, "/dev/full", "--sensor", 0, code=2)
    assert "cannot write /dev/full: No space left" in one_sentence(failed)
    tool("snapshot", near, path, "--sensor", 7, code=2)
    assert sorted(tmp_path.iterdir()) == [path, link, pipe], "nothing else is left"


def test_another_sensors_snapshot_is_refused(chain: Bench, tmp_path: Path) -> None:
    near, path = chain[0].near, tmp_path / "a.json"
    tool("apply", near, "--sensor", 0, "--set", "sinc_length=128")
    tool("snapshot", near, path, "--sensor", 0)
    refused = tool("restore", near, path, "--sensor", 1, code=1)
    assert "serial 10, but this is the BFT-SENS-ECAT-M8 with serial 20" in one_sentence(refused)
    assert written(chain[1], 1) == []
    assert "sinc_length  64   128" in tool("restore", near, path, "--sensor", 1, "--force").out
