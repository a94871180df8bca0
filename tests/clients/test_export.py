"""`ethercat-export`: what pandas, MATLAB and a spreadsheet get is what was recorded."""

from __future__ import annotations

import csv
import re
import struct
from pathlib import Path
from typing import Any

import pytest

from bota_clients.export.cli import main
from bota_clients.export.csv_table import COLUMNS
from bota_clients.recording.reader import Recording
from bota_ethercat.framing import DataFlag
from tests.clients.recordings import PERIOD_NS, START_NS, frame, record
from tests.ended import Result, run_here

DOCS = (Path(__file__).parents[2] / "docs" / "recording.md").read_text()


def export(*arguments: object, code: int = 0) -> Result:
    ended = run_here(main, *arguments)
    assert ended.code == code, ended.err
    return ended


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_line_is_a_sample_in_si_units(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "run.csv"
    third = struct.unpack("<f", struct.pack("<f", 1 / 3))[0]
    values: dict[str, Any] = {
        "force.z": third,
        "torque.y": -1e-7,
        "acceleration.z": 1.0,
        "angular_rate.x": 180.0,
        "status": 5,
    }
    estimate: dict[str, Any] = {"orientation.w": 1.0, "warnings": 3}
    record(path, [frame(0), frame(1, **values), frame(2, size=77, **estimate)])
    assert "run.csv: 3 samples\n" in export(path).err
    first, second, third_row = rows(out)
    assert tuple(first) == COLUMNS
    assert (first["time_s"], second["time_s"]) == ("0.000000000", f"0.{PERIOD_NS:09d}")
    assert second["stamp_utc"].endswith(f".{(START_NS + PERIOD_NS) % 10**9:09d}Z")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{9}Z", second["stamp_utc"])
    assert struct.pack("<f", float(second["force_z_N"])) == struct.pack("<f", third)
    assert float(second["torque_y_Nm"]) == pytest.approx(-1e-7)
    assert float(second["acceleration_z_m_s2"]) == pytest.approx(9.80665)
    assert float(second["angular_rate_x_rad_s"]) == pytest.approx(3.14159265)
    assert (second["temperature_degC"], second["orientation_w"], second["status"]) == ("35.5", "", "5")
    assert (third_row["orientation_x"], third_row["orientation_w"], third_row["warnings"]) == ("0", "1", "3")


def test_what_is_no_new_sample_is_left_out_but_not_its_gap(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "out.csv"
    gap, repeated, invalid = DataFlag.GAP, DataFlag.REPEATED, DataFlag.INVALID
    record(
        path,
        [frame(0), frame(1, flags=repeated | gap), frame(2, flags=invalid), frame(3), frame(4),
         frame(5, sensor=1, flags=gap)],
        sensors=(0, 1),
    )  # fmt: skip
    said = export(path, out)
    assert "out.csv: 4 samples; 2 frames without a new sample left out" in said.err
    found = [(row["sensor"], row["sequence"], row["gap"]) for row in rows(out)]
    assert found == [("0", "0", "0"), ("0", "3", "1"), ("0", "4", "0"), ("1", "5", "1")]
    export(path, out, "--all", "--force", "--sensor", 0)
    flags = [(row["gap"], row["repeated"], row["invalid"]) for row in rows(out)]
    assert flags == [("0", "0", "0"), ("1", "1", "0"), ("0", "0", "1"), ("0", "0", "0"), ("0", "0", "0")]


def test_time_is_the_monotonic_clocks(tmp_path: Path) -> None:
    """The wall clock is set back by an hour; then the machine is restarted, and its clock begins anew."""
    path, hour_ns, second_ns = tmp_path / "run.mcap", 3600 * 10**9, 10**9
    made = [frame(number) for number in range(8000, 8006)]
    made[2:4] = [item._replace(stamp_ns=item.stamp_ns - hour_ns) for item in made[2:4]]
    made[4:] = [
        item._replace(
            stamp_ns=item.stamp_ns - hour_ns + second_ns, monotonic_ns=item.monotonic_ns - 9 * second_ns
        )
        for item in made[4:]
    ]
    record(path, made)
    export(path)
    times = [0, PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS, second_ns + 4 * PERIOD_NS, second_ns + 5 * PERIOD_NS]
    assert [row["time_s"] for row in rows(path.with_suffix(".csv"))] == [f"{ns / 1e9:.9f}" for ns in times]


def test_time_begins_with_the_earliest_of_several_sensors(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, [frame(8001), frame(8000, 1), frame(8002), frame(8001, 1)], sensors=(0, 1))
    export(path)
    times = [float(row["time_s"]) for row in rows(path.with_suffix(".csv"))]
    assert times == [PERIOD_NS * 1e-9 * n for n in (1, 0, 2, 1)]


def test_what_cannot_be_done_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "run.csv"
    record(path, [frame(0)])
    out.write_text("mine")
    assert "run.csv exists: choose another name, or use --force" in export(path, code=1).err
    assert out.read_text() == "mine"
    out.unlink()
    assert "has no samples of sensor 3" in export(path, "--sensor", 3, code=1).err
    assert "No such file" in export(tmp_path / "no.mcap", code=1).err
    assert "would overwrite the recording" in export(path, path, code=2).err
    assert list(tmp_path.iterdir()) == [path]


def test_ctrl_c_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    path = tmp_path / "run.mcap"
    record(path, [frame(0)])
    monkeypatch.setattr(Recording, "tables", interrupted)
    assert export(path, code=1).err == "ethercat-export: stopped: nothing was written\n"
    assert list(tmp_path.iterdir()) == [path]


def test_the_columns_are_described() -> None:
    text = DOCS[DOCS.index("## ethercat-export") : DOCS.index("## File format")]
    for name in COLUMNS:
        stem = re.match(r"(force|torque|acceleration|angular_rate|orientation)_[xyzw]", name)
        assert f"`{name}`" in text or (stem and f"`{stem[1]}_x" in text), name
