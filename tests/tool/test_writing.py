"""`apply`, `save`, `tare`, `snapshot` and `restore` without a server, on simulated sensors."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from ethercat_server.errors import BusError
from ethercat_server.ethercat.datagrams import Steps
from tests.simulation import SimulatedBus, more_if_long, simulated_bus
from tests.tool.odd_firmware import fewer_objects, refusing
from tests.tool.running import offset, one_sentence, refused, told, tool_here

TARGET = ("--target", "1", "2", "3", "4", "5", "6")


@pytest.fixture
def bench() -> Iterator[SimulatedBus]:
    """Its sensor has 77 bytes of process data; those of the others have 61."""
    with simulated_bus("--pdo", "77", "--signal", "rest", "--serial", "4711") as bus:
        yield bus


def test_plan_says_what_would_change_and_writes_nothing(bench: SimulatedBus) -> None:
    near = bench.near
    asked = ("--set", "sinc_length=128", "--set", "fir=on", "--set", "imu_active=1")
    shown = tool_here("apply", "--dry-run", near, *asked, code=3).out
    assert "sinc_length  64     128   400 Hz; cut-off 105 Hz with FIR off, 16 Hz with FIR on" in shown
    assert "cut-off 16 Hz, delay 30 ms (derived" in shown
    found = told("apply", "--dry-run", near, *asked, code=3)
    changes = [(row["name"], row["now"], row["then"]) for row in found["changes"]]
    assert changes == [("fir", False, True), ("sinc_length", 64, 128)]
    assert (found["meaning"]["cutoff_hz"], found["rate_hz"], found["saved"]) == (16.0, 400, False)
    assert told("apply", "--dry-run", near, "--set", "sinc_length=64")["changes"] == []
    assert bench.written() == []


def test_apply_does_what_plan_says_and_a_file_says_it_too(bench: SimulatedBus, tmp_path: Path) -> None:
    near = bench.near
    config = tmp_path / "sensor.toml"
    config.write_text("[sensor]\nsinc_length = 205\nacceleration_range_g = 8\n[sensor.0]\nchop = true\n")
    applied = told("apply", near, "--config", config)
    assert (applied["rate_hz"], applied["saved"]) == (250, False)
    asked = {"sinc_length": 205, "acceleration_range_g": 8, "chop": True, "fir": False}
    assert asked.items() <= applied["settings"].items()
    assert "nothing to change" in tool_here("apply", near, "--config", config).out
    tool_here("apply", "--dry-run", near, "--config", config)
    bench.power_cycle()
    tool_here("apply", "--dry-run", near, "--config", config, code=3)  # it was not saved
    config.write_text("[sensor]\nsinc_length = 205\n[sensor.7]\nfir = true\n")
    said = refused("apply", near, "--config", config, code=2)
    assert "has settings for sensor 7, but the bus has only 0: BFT-SENS-ECAT-M8 with serial 4711" in said


def test_apply_and_save_keep_it_over_a_power_cut(bench: SimulatedBus) -> None:
    near = bench.near
    tool_here("apply", near, "--set", "sinc_length=256", "--save")
    tool_here("apply", near, "--set", "temperature_compensation=true")
    tool_here("save", near)
    assert bench.written().count(("0x8030", 1, "01")) == 2
    bench.power_cycle()
    asked = ("--set", "sinc_length=256", "--set", "temperature_compensation=true")
    assert "nothing to change" in tool_here("apply", "--dry-run", near, *asked).out


def test_a_chain_wants_a_choice(chain: SimulatedBus) -> None:
    near = chain.near
    said = refused("apply", near, "--set", "fir=on", code=2)
    assert "choose one with --sensor" in said
    assert "serial 20" in said
    assert "more than one sensor matches" in refused("save", near, "--sensor", "BFT-SENS-ECAT-M8", code=2)
    tool_here("save", near, "--sensor", 20)
    assert (chain.written(), chain.written(1)) == ([], [("0x8030", 1, "01")])


def test_apply_that_fails_half_way_takes_everything_back(
    single: SimulatedBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusing(monkeypatch)
    near, path = single.near, tmp_path / "a.json"
    asked = ("--set", "sinc_length=128", "--set", "fir=on", "--set", "imu_active=3")
    failed = tool_here("apply", near, *asked, "--json", code=1)
    assert "; the former settings are in force" in one_sentence(failed)
    # The same of a snapshot whose settings take, but not its last offsets.
    tool_here("snapshot", near, path)
    content = json.loads(path.read_text())
    content["settings"]["imu_active"] = 3
    for row in content["objects"]:
        if row["index"] == "0x8000" and row["subindex"] in {1, 5}:
            row["hex"] = "0000003f"
    path.write_text(json.dumps(content))
    assert "the former settings are in force" in refused("restore", near, path)
    assert ("0x8000", 1, "0000003f") in single.written()
    assert len(told("apply", "--dry-run", near, *asked, code=3)["changes"]) == 3
    assert offset(near) == [0.0] * 6


def test_settings_that_a_sensor_lacks_are_named(
    single: SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    fewer_objects(monkeypatch)
    near = single.near
    said = refused("apply", near, "--set", "coordinate_system=on", "--set", "fir=on")
    assert "has no setting coordinate_system: object 0x8010:4" in said
    assert single.written() == []
    assert told("apply", near, "--set", "fir=on")["settings"]["fir"] is True
    assert "0x8010:5" in tool_here("objects", near).out


def let_chop_divide(bus: SimulatedBus) -> None:
    life = bus.backend.sensors.sensors[0].life
    assert life is not None
    life.dictionary.let_chop_divide(2)


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
        ended = tool_here("tare", bus.near, "--samples", 20, *TARGET, code=None)
        codes.append(ended.code)
        assert ("ethercat-sensor: stopped before it was done" in ended.err) is bool(ended.code)
        new = offset(bus.near)
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
def test_a_tare_cut_off_half_way_leaves_the_old_offset_or_tells_it(fault: str, said: str) -> None:
    with simulated_bus("--signal", "rest", "--noise", "none", "--sinc", "512") as bus:
        assert "old offset" in tool_here("tare", bus.near, "--samples", 20).out
        bus.command(f"on-write 0x8000 3 {fault}")
        failed = tool_here("tare", bus.near, "--samples", 20, *TARGET, code=1)
        assert said in failed.err.splitlines()[-1]
        if "back" in said:
            assert offset(bus.near) == [-1.5, 2.25, 9.75, -0.125, 0.0625, -0.03125]


def test_a_snapshot_is_restored_as_far_as_it_differs(bench: SimulatedBus, tmp_path: Path) -> None:
    near = bench.near
    path = tmp_path / "a.json"
    tool_here("apply", near, "--set", "sinc_length=341", "--set", "fir=on")
    assert told("snapshot", near, path)["objects"] > 100
    content = json.loads(path.read_text())
    who = {"model": "BFT-SENS-ECAT-M8", "serial": 4711, "firmware": "1.3.8-dirty-R"}
    assert who.items() <= content.items()
    before = bench.written()
    assert "nothing to restore" in tool_here("restore", near, path).out
    assert bench.written() == before
    bench.power_cycle()
    for row in content["objects"]:
        if row["index"] in {"0x2000", "0x8001", "0x8030"} and row["subindex"] == 1:
            row["hex"] = row["hex"].replace("0", "1")
    path.write_text(json.dumps(content))
    restored = told("restore", near, path, "--save")
    assert {row["name"] for row in restored["changes"]} == {"sinc_length", "fir"}
    assert [(row["index"], row["subindex"]) for row in restored["objects"]] == [("0x8001", 1)]
    later = bench.written()
    assert {(index, sub) for index, sub, _ in later} == {
        ("0x8006", 1), ("0x8006", 2), ("0x8001", 1), ("0x8030", 1),
    }, "the command is the save's, and the factory calibration is left alone"  # fmt: skip
    assert later.count(("0x8030", 1, "01")) == 1
    assert "nothing to restore" in tool_here("restore", near, path).out


def test_another_sensors_snapshot_is_refused(chain: SimulatedBus, tmp_path: Path) -> None:
    near, path = chain.near, tmp_path / "a.json"
    tool_here("apply", near, "--sensor", 0, "--set", "sinc_length=128")
    tool_here("snapshot", near, path, "--sensor", 0)
    said = refused("restore", near, path, "--sensor", 1)
    assert "serial 10, but this is the BFT-SENS-ECAT-M8 with serial 20" in said
    assert chain.written(1) == []
    assert "sinc_length  512  128" in tool_here("restore", near, path, "--sensor", 1, "--force").out
    tool_here("snapshot", near, path, "--sensor", 1, "--force")
    assert json.loads(path.read_text())["serial"] == 20


@pytest.mark.parametrize("how", ["--undo", "--clear"])
def test_a_tare_is_undone_or_cleared_and_that_undone_again(bench: SimulatedBus, how: str) -> None:
    tared = told("tare", bench.near, "--samples", 50)["new_offset"]
    assert offset(bench.near) == pytest.approx(tared, rel=1e-5)
    undone = told("tare", bench.near, how)
    assert (undone["new_offset"], offset(bench.near)) == ([0.0] * 6, [0.0] * 6)
    assert "new offset" in tool_here("tare", bench.near, "--undo").out
    assert offset(bench.near) == pytest.approx(tared, rel=1e-5)


def test_only_the_tare_that_is_in_force_is_undone(bench: SimulatedBus) -> None:
    tool_here("tare", bench.near, "--samples", 50)
    bench.power_cycle()
    assert "has changed since its last tare here" in refused("tare", bench.near, "--undo")
    assert offset(bench.near) == [0.0] * 6


@pytest.mark.parametrize("content", [None, "", "[]", '{"4711": 1}', '{"4711": {"before": [1], "after": 2}}'])
def test_without_a_known_tare_there_is_nothing_to_undo(
    bench: SimulatedBus, state: Path, content: str | None
) -> None:
    file = state / "bota-ethercat-bridge" / "tares.json"
    file.unlink(missing_ok=True)
    if content is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    assert "no tare of sensor 0: BFT-SENS-ECAT-M8, serial 4711" in refused("tare", bench.near, "--undo")
    assert bench.written() == []


def test_a_clearing_that_does_not_take_leaves_the_old_offset(bench: SimulatedBus) -> None:
    tool_here("tare", bench.near, "--samples", 50)
    before = offset(bench.near)
    bench.command("on-write 0x8000 2 abort 0x8000 3 0x08000022")
    assert "the old offset is in force" in refused("tare", bench.near, "--clear")
    assert offset(bench.near) == before


def test_a_clearing_that_cannot_be_undone_says_both(
    bench: SimulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = count(1)

    def write(*_: object) -> Steps[Any]:
        yield from ()
        raise BusError(f"write {next(attempts)} failed")

    monkeypatch.setattr("ethercat_server.tool.settings.write_offset", write)
    said = refused("tare", bench.near, "--clear")
    assert said.endswith(
        "write 1 failed; restoring the former offset failed too: write 2 failed; tare it again"
    )


UNMATCHED = ": by the sampling rate, which this length does not match"
MEANINGS = {
    64: (384, "800 Hz; cut-off 209.5 Hz with FIR off, 31.5 Hz with FIR on" + UNMATCHED),
    128: (768, "400 Hz; cut-off 105 Hz with FIR off, 16 Hz with FIR on" + UNMATCHED),
    341: (2048, "150 Hz; cut-off 39.5 Hz with FIR off, 6 Hz with FIR on" + UNMATCHED),
    1000: (6024, "51 Hz; cut-off not in the table" + UNMATCHED),
    2048: (12288, "25 Hz; cut-off not in the table" + UNMATCHED),
}


@pytest.mark.parametrize("length", more_if_long([128, 1000], MEANINGS))
def test_what_is_said_of_it_follows_the_rate(single: SimulatedBus, length: int) -> None:
    applied = told("apply", single.near, "--set", f"sinc_length={length}")
    assert applied["settings"]["sinc_length"] == length
    (read,) = told("read", single.near, "sinc_length")["sensors"][0]["objects"]
    assert (read["value"], read["meaning"]) == MEANINGS[length]
    assert MEANINGS[length][1] in tool_here("objects", single.near).out


def test_a_length_that_chop_hides_is_not_overwritten(single: SimulatedBus) -> None:
    let_chop_divide(single)
    assert told("apply", single.near, "--set", "chop=on")["rate_hz"] == 400
    assert told("apply", "--dry-run", single.near, "--set", "imu_active=3", code=3)["rate_hz"] == 400
    written = single.written()
    assert told("apply", single.near, "--set", "imu_active=3")["rate_hz"] == 400
    assert {row[0] for row in single.written()[len(written) :]} == {"0x8010"}
    asked = ("--set", "sinc_length=64")
    assert "nothing to change" in tool_here("apply", "--dry-run", single.near, *asked).out
    (read,) = told("read", single.near, "sinc_length")["sensors"][0]["objects"]
    assert (read["value"], read["meaning"]) == (384, "400 Hz; cut-off not in the table" + UNMATCHED)


@pytest.mark.parametrize("length", more_if_long([32, 342], [32, 128, 341, 342, 1000]))
def test_plan_and_restore_end(single: SimulatedBus, length: int, tmp_path: Path) -> None:
    asked = ("--set", f"sinc_length={length}")
    tool_here("apply", "--dry-run", single.near, *asked, code=3)
    tool_here("apply", single.near, *asked)
    assert "nothing to change" in tool_here("apply", "--dry-run", single.near, *asked).out
    path = tmp_path / "a.json"
    tool_here("snapshot", single.near, path)
    content = json.loads(path.read_text())
    content["settings"]["sinc_length"] = length  # of several with this rate, it cannot know which
    path.write_text(json.dumps(content))
    assert "nothing to restore" in tool_here("restore", single.near, path).out
    tool_here("apply", single.near, "--set", "sinc_length=64", "--set", "fir=on")
    restored = told("restore", single.near, path)
    assert {row["name"]: row["then"] for row in restored["changes"]} == {"sinc_length": length, "fir": False}
    assert "nothing to restore" in tool_here("restore", single.near, path).out
    assert single.stats()["sinc_length"] == length
