"""`plan`, `apply`, `save`, `tare`, `snapshot` and `restore` without a server, on simulated sensors."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.simulated_links import simulated_bus
from tests.simulation import SimulatedBus
from tests.tool.odd_firmware import fewer_objects, refusing
from tests.tool.running import one_sentence, tool_here

TARGET = ("--target", "1", "2", "3", "4", "5", "6")


@pytest.fixture
def bench() -> Iterator[SimulatedBus]:
    """Its sensor has 77 bytes of process data; those of the others have 61."""
    with simulated_bus("--pdo", "77", "--signal", "rest", "--serial", "4711") as bus:
        yield bus


@pytest.fixture
def chain() -> Iterator[SimulatedBus]:
    with simulated_bus("--sensors", "2", "--serial", "10,20") as bus:
        yield bus


@pytest.fixture
def single() -> Iterator[SimulatedBus]:
    with simulated_bus("--signal", "rest") as bus:
        yield bus


def test_plan_says_what_would_change_and_writes_nothing(bench: SimulatedBus) -> None:
    near = bench.near
    asked = ("--set", "sinc_length=128", "--set", "fir=on", "--set", "imu_active=1")
    shown = tool_here("plan", near, *asked, code=3).out
    assert "sinc_length  64     128   400 Hz; cut-off 105 Hz with FIR off, 16 Hz with FIR on" in shown
    assert "cut-off 16 Hz, added delay not in the table" in shown
    found = tool_here("plan", near, *asked, "--json", code=3).json
    assert [(row["name"], row["now"], row["then"]) for row in found["changes"]] == [
        ("fir", False, True),
        ("sinc_length", 64, 128),
    ]
    assert (found["now"]["cutoff_hz"], found["then"]["cutoff_hz"]) == (209.5, 16.0)
    assert tool_here("plan", near, "--set", "sinc_length=64", "--json").json["changes"] == []
    assert bench.written() == []


def test_apply_does_what_plan_says_and_a_file_says_it_too(bench: SimulatedBus, tmp_path: Path) -> None:
    near = bench.near
    config = tmp_path / "sensor.toml"
    config.write_text("[sensor]\nsinc_length = 205\nacceleration_range_g = 8\n[sensor.0]\nchop = true\n")
    applied = tool_here("apply", near, "--config", config, "--json").json
    assert (applied["rate_hz"], applied["saved"]) == (250, False)
    assert {"sinc_length": 205, "acceleration_range_g": 8, "chop": True, "fir": False}.items() <= applied[
        "settings"
    ].items()
    again = tool_here("apply", near, "--config", config)
    assert "nothing to change" in again.out
    assert tool_here("plan", near, "--config", config).code == 0
    bench.power_cycle()
    assert tool_here("plan", near, "--config", config, code=3), "it was not saved"
    config.write_text("[sensor]\nsinc_length = 205\n[sensor.7]\nfir = true\n")
    for name in ("plan", "apply"):
        said = one_sentence(tool_here(name, near, "--config", config, code=2))
        assert "has settings for sensor 7, but the bus has only 0: BFT-SENS-ECAT-M8 with serial 4711" in said


def test_apply_and_save_keep_it_over_a_power_cut(bench: SimulatedBus) -> None:
    near = bench.near
    tool_here("apply", near, "--set", "sinc_length=256", "--save")
    tool_here("apply", near, "--set", "temperature_compensation=true")
    tool_here("save", near)
    assert bench.written().count(("0x8030", 1, "01")) == 2
    bench.power_cycle()
    asked = ("--set", "sinc_length=256", "--set", "temperature_compensation=true")
    assert "nothing to change" in tool_here("plan", near, *asked).out


def test_a_power_cut_in_the_save_says_what_holds(bench: SimulatedBus) -> None:
    near = bench.near
    bench.command("cut-save 5")
    said = one_sentence(tool_here("apply", near, "--set", "fir=true", "--save", code=1))
    assert said.endswith("; whether it saved all, some or none of its settings is not known: save again")


def test_a_chain_wants_a_choice(chain: SimulatedBus) -> None:
    near = chain.near
    said = one_sentence(tool_here("apply", near, "--set", "fir=on", code=2))
    assert "choose one with --sensor" in said
    assert "serial 20" in said
    assert "more than one sensor matches" in one_sentence(
        tool_here("save", near, "--sensor", "BFT-SENS-ECAT-M8", code=2)
    )
    assert chain.written() == []


def test_apply_that_fails_half_way_takes_everything_back(
    single: SimulatedBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusing(monkeypatch)
    near = single.near
    asked = ("--set", "sinc_length=128", "--set", "fir=on", "--set", "imu_active=3")
    failed = tool_here("apply", near, *asked, "--json", code=1)
    assert "sinc_length = 128 did not take" in failed.json["error"]
    assert "the former settings are in force" in one_sentence(failed)
    assert ("0x8006", 2, "00") in single.written(), "FIR had been switched on"
    assert len(tool_here("plan", near, *asked, "--json", code=3).json["changes"]) == 3
    # The same of a snapshot whose settings take, but not its last offsets.
    path = tmp_path / "a.json"
    tool_here("snapshot", near, path)
    content = json.loads(path.read_text())
    content["settings"]["imu_active"] = 3
    for row in content["objects"]:
        if row["index"] == "0x8000" and row["subindex"] in {1, 5}:
            row["hex"] = "0000003f"
    path.write_text(json.dumps(content))
    assert "the former settings are in force" in one_sentence(tool_here("restore", near, path, code=1))
    assert ("0x8000", 1, "0000003f") in single.written()
    assert len(tool_here("plan", near, *asked, "--json", code=3).json["changes"]) == 3
    rows = tool_here("objects", near, "--json").json["sensors"][0]["objects"]
    assert [row["value"] for row in rows if row["index"] == "0x8000"] == [6, 0, 0, 0, 0, 0, 0]


def test_settings_that_a_sensor_lacks_are_named(
    single: SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    fewer_objects(monkeypatch)
    near = single.near
    said = one_sentence(tool_here("apply", near, "--set", "coordinate_system=on", "--set", "fir=on", code=1))
    assert "has no setting coordinate_system" in said
    assert "0x8010:4" in said
    assert single.written() == []
    assert tool_here("apply", near, "--set", "fir=on", "--json").json["settings"]["fir"] is True
    assert "0x8010:5" in tool_here("objects", near).out


def test_chop_that_divides_the_rate_is_taken_and_told(single: SimulatedBus) -> None:
    near, life = single.near, single.backend.sensors.sensors[0].life
    assert life is not None
    life.dictionary.let_chop_divide(2)
    applied = tool_here("apply", near, "--set", "chop=on", "--json").json
    assert (applied["rate_hz"], applied["meaning"]["rate_hz"], applied["meaning"]["cutoff_hz"]) == (
        400,
        400,
        None,
    )
    assert applied["settings"]["chop"], "the length reads back as another one"
    planned = tool_here("plan", near, "--set", "chop=on", "--json").json
    assert (planned["changes"], planned["then"]["rate_hz"]) == ([], 400)
    planned = tool_here("plan", near, "--set", "imu_active=3", "--json", code=3).json
    assert planned["then"]["rate_hz"] == 400
    assert len(tool_here("tare", near, "--samples", 20, "--json").json["new_offset"]) == 6
    watched = tool_here("watch", near, "--samples", 100, "--interval", 9, "--json").json
    assert (round(watched["rate_hz"]), watched["gaps"]) == (400, 0)


def test_tare_makes_the_mean_the_target(bench: SimulatedBus) -> None:
    near = bench.near
    target = ("1", "-2", "3", "0.1", "0.2", "-0.3")
    tared = tool_here("tare", near, "--samples", 100, "--target", *target, "--json").json
    assert tared["old_offset"] == [0.0] * 6
    assert max(map(abs, tared["residual"])) < 1e-5
    rows = tool_here("objects", near, "--json").json["sensors"][0]["objects"]
    held = [row["value"] for row in rows if row["index"] == "0x8000"][1:]
    assert held == pytest.approx(tared["new_offset"], rel=1e-5)
    assert {row[0] for row in bench.written()} == {"0x8000"}, "nothing but the offset"


@pytest.mark.parametrize("motion", ["turn", "scene"])
def test_a_tare_of_a_moving_sensor_is_refused(motion: str) -> None:
    """Whether it is seen before or after the offset was written: the former one is in force."""
    refused = 0
    with simulated_bus("--signal", motion) as bus:
        for _ in range(2):
            done = tool_here("tare", bus.near, "--samples", 400, "--json", code=None)
            if done.code == 0:  # it rested for a moment
                assert max(map(abs, done.json["residual"][:3])) < 0.4
                break
            assert done.code == 1
            assert re.search("[FM][xyz] (changes by|is -?[0-9.]+ Nm? off target)", one_sentence(done))
            read = tool_here("read", bus.near, "Force/Torque Offset", "--json").json["sensors"][0]["objects"]
            assert [row["value"] for row in read[1:]] == [0.0] * 6
            refused += 1
    assert refused


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_tare_that_is_stopped_changes_nothing(number: signal.Signals) -> None:
    with simulated_bus("--signal", "sine") as bus:
        states: list[str] = []

        def stop() -> None:
            states.append(bus.stats()["al_state"])
            signal.raise_signal(number)

        bus.at(1.0, stop)
        stopped = tool_here("tare", bus.near, "--samples", 20000, code=1)
        assert (one_sentence(stopped), states) == ("ethercat-sensor: stopped before it was done", ["OP"])
        assert bus.written() == []


def test_a_tare_that_is_stopped_at_any_moment_is_done_or_not_begun() -> None:
    with simulated_bus("--signal", "rest") as bus:
        began_ns = bus.clock.now_ns
        tool_here("tare", bus.near, "--samples", 20, *TARGET)
        takes_s = (bus.clock.now_ns - began_ns) * 1e-9
    codes = [stopped_tare(takes_s - 0.001 * before) for before in (140, 90, 60, 30, 15, 5, 1.5, 0.3)]
    assert codes == sorted(codes, reverse=True)
    assert set(codes) == {0, 1}


def stopped_tare(seconds: float) -> int:
    """The exit code of a tare that is stopped then."""
    with simulated_bus("--signal", "rest") as bus:
        codes: list[int] = []

        def stop() -> None:
            if not codes:
                signal.raise_signal(signal.SIGINT)

        bus.at(seconds, stop)
        codes.append(tool_here("tare", bus.near, "--samples", 20, *TARGET, code=None).code)
        read = tool_here("read", bus.near, "Force/Torque Offset", "--json").json["sensors"][0]["objects"]
        new = [row["value"] for row in read[1:]]
        assert new == [0.0] * 6 if codes[0] else 0.0 not in new
        return codes[0]


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("deaf 0.5", "; it is back with its old offset"),
        ("power cycle 0.3", "; it is back with its old offset"),
        ("deaf", "; its offset may be half written (it was -1.5 2.25 9.75 -0.125 0.0625 -0.03125): tare it"),
    ],
)
def test_a_tare_cut_off_half_way_leaves_the_old_offset_or_tells_it(
    single: SimulatedBus, fault: str, said: str
) -> None:
    assert "old offset" in tool_here("tare", single.near, "--samples", 20).out
    single.command(f"on-write 0x8000 3 {fault}")
    failed = tool_here("tare", single.near, "--samples", 20, *TARGET, code=1)
    assert said in failed.err.splitlines()[-1]
    if "back" in said:
        read = tool_here("read", single.near, "Force/Torque Offset", "--json").json["sensors"][0]["objects"]
        assert [row["value"] for row in read[1:]] == [-1.5, 2.25, 9.75, -0.125, 0.0625, -0.03125]


def test_a_snapshot_is_restored_as_far_as_it_differs(bench: SimulatedBus, tmp_path: Path) -> None:
    near = bench.near
    path = tmp_path / "a.json"
    tool_here("apply", near, "--set", "sinc_length=341", "--set", "fir=on")
    assert tool_here("snapshot", near, path, "--json").json["objects"] > 100
    content = json.loads(path.read_text())
    assert (content["model"], content["serial"], content["firmware"]) == (
        "BFT-SENS-ECAT-M8",
        4711,
        "1.3.8-dirty-R",
    )
    before = bench.written()
    assert "nothing to restore" in tool_here("restore", near, path).out
    assert bench.written() == before
    bench.power_cycle()
    for row in content["objects"]:
        if row["index"] in {"0x2000", "0x8001", "0x8030"} and row["subindex"] == 1:
            row["hex"] = row["hex"].replace("0", "1")
    path.write_text(json.dumps(content))
    restored = tool_here("restore", near, path, "--save", "--json").json
    assert {row["name"] for row in restored["changes"]} == {"sinc_length", "fir"}
    assert [(row["index"], row["subindex"]) for row in restored["objects"]] == [("0x8001", 1)]
    later = bench.written()
    assert {(index, sub) for index, sub, _ in later} == {
        ("0x8006", 1), ("0x8006", 2), ("0x8001", 1), ("0x8030", 1),
    }, "the command is the save's, and the factory calibration is left alone"  # fmt: skip
    assert later.count(("0x8030", 1, "01")) == 1
    assert "nothing to restore" in tool_here("restore", near, path).out


def test_a_snapshot_follows_links_and_replaces_no_device(chain: SimulatedBus, tmp_path: Path) -> None:
    near, path, link, pipe = chain.near, tmp_path / "a.json", tmp_path / "link", tmp_path / "pipe"
    link.symlink_to(path)
    os.mkfifo(pipe)
    with open(pipe, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as reading:
        for file in (link, pipe):
            tool_here("snapshot", near, file, "--sensor", 0)
        assert json.load(reading)["serial"] == 10
    assert link.is_symlink()
    assert json.loads(path.read_text())["serial"] == 10
    assert pipe.is_fifo()
    failed = tool_here("snapshot", near, "/dev/full", "--sensor", 0, code=1)
    assert "/dev/full cannot be written: No space left" in one_sentence(failed)
    tool_here("snapshot", near, path, "--sensor", 7, "--force", code=2)
    kept = path.read_text()
    assert "a.json exists: choose another name, or use --force" in one_sentence(
        tool_here("snapshot", near, path, "--sensor", 1, code=1)
    )
    assert path.read_text() == kept
    tool_here("snapshot", near, path, "--sensor", 1, "--force")
    assert json.loads(path.read_text())["serial"] != 10
    assert sorted(tmp_path.iterdir()) == [path, link, pipe], "nothing else is left"


def test_another_sensors_snapshot_is_refused(chain: SimulatedBus, tmp_path: Path) -> None:
    near, path = chain.near, tmp_path / "a.json"
    tool_here("apply", near, "--sensor", 0, "--set", "sinc_length=128")
    tool_here("snapshot", near, path, "--sensor", 0)
    refused = tool_here("restore", near, path, "--sensor", 1, code=1)
    assert "serial 10, but this is the BFT-SENS-ECAT-M8 with serial 20" in one_sentence(refused)
    assert chain.written(1) == []
    assert "sinc_length  64   128" in tool_here("restore", near, path, "--sensor", 1, "--force").out
