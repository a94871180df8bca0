"""All samples as `.parquet` and `.npz`: one row a sample, in the places that windows give them."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bota_clients.export.cli import main
from bota_clients.export.csv_table import COLUMNS
from bota_clients.export.dataset import Periodic, Stamped, windows_of
from bota_clients.export.samples import samples_of
from bota_clients.export.windows import Arrays, Windows
from bota_clients.recording.reader import open_recording
from bota_ethercat.framing import DataFlag, DataMessage
from tests.clients.recordings import PERIOD_NS, START_NS, describe, frame, record, write
from tests.clients.simulated import simulate
from tests.clients.test_export_windows import NOT_FINITE, SETTINGS, TOOL, joined, stamps, tared
from tests.descriptions import sensor_row
from tests.ended import run_here

GAP, REPEATED, INVALID = int(DataFlag.GAP), int(DataFlag.REPEATED), int(DataFlag.INVALID)


def samples(path: Path, frames: Iterable[DataMessage], length: int = 1000) -> Arrays:
    """Of a recording of these frames."""
    record(path, frames, **SETTINGS)
    with open_recording(path) as recording:
        return joined(samples_of(recording, Windows(length)))


def test_a_row_is_a_sample_with_the_names_and_values_of_the_csv(tmp_path: Path) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "run.npz"
    values: Any = {"force.z": 1 / 3, "acceleration.z": 1.0, "angular_rate.x": 180.0, "status": 5}
    orientation: Any = {"orientation.w": 1.0, "warnings": 3}
    record(path, [frame(0), frame(1, **values), frame(2, size=77, **orientation)], **SETTINGS)
    for each in (out, tmp_path / "run.csv"):
        assert run_here(main, path, each).code == 0
    made = np.load(out)
    assert tuple(name for name in COLUMNS if name in made) == tuple(name for name in made if name in COLUMNS)
    assert {*COLUMNS} - {*made} == {"sensor", "repeated", "invalid"}
    assert {*made} - {*COLUMNS} == {"monotonic_ns", "valid", "attributes"}
    with (tmp_path / "run.csv").open(newline="") as file:
        for row, line in enumerate(csv.DictReader(file)):
            for name in {*made} & {*COLUMNS} - {"stamp_utc"}:
                wanted = float(line[name] or "nan")
                assert made[name][row] == pytest.approx(wanted, rel=1e-7, nan_ok=True), name
            assert f"{made['stamp_utc'][row]}Z" == line["stamp_utc"]
    assert json.loads(str(made["attributes"]))["units"]["force"] == "N"


def test_a_lost_sample_is_a_row_that_is_not_valid(tmp_path: Path) -> None:
    """2 and 3 were not read in time, 5 is INVALID, 7 saturated, 8 not finite; before 10 one was lost."""
    frames = [frame(number) for number in (0, 1, 4, 5, 6, 7, 8, 9)]
    frames[3] = frames[3]._replace(flags=INVALID | GAP)
    frames[5], frames[6] = frame(7, warnings=1), frame(8, **NOT_FINITE)
    frames.append(frame(11, flags=GAP)._replace(sequence=10))
    path, out = tmp_path / "run.mcap", tmp_path / "run.npz"
    record(path, frames, **SETTINGS)
    said = run_here(main, path, out).err
    made = np.load(out)
    assert said.endswith("run.npz: 12 samples, 6 of them not valid\n")
    assert made["sequence"].tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, -1, 10]
    assert made["monotonic_ns"].tolist() == [number * PERIOD_NS for number in range(12)]
    assert (made["stamp_utc"].astype(int) - START_NS).tolist() == [number * PERIOD_NS for number in range(12)]
    assert made["time_s"] == pytest.approx(np.arange(12) * 1.25e-3)
    assert np.flatnonzero(~made["valid"]).tolist() == [2, 3, 5, 7, 8, 10]
    for name in ("force_x_N", "acceleration_x_m_s2", "angular_rate_z_rad_s", "temperature_degC"):
        assert np.flatnonzero(np.isnan(made[name])).tolist() == [2, 3, 5, 10], name
    assert made["force_x_N"][7] == 7, "what is saturated is there, but not valid"
    assert np.flatnonzero(made["gap"]).tolist() == [6, 11], "INVALID frames hand theirs on"
    assert made["warnings"].tolist() == [0] * 7 + [1] + [0] * 4


def test_where_repeated_frames_may_be_among_the_missing_there_is_no_number(tmp_path: Path) -> None:
    frames = [
        frame(0),
        frame(1),
        frame(4)._replace(sequence=6),
        frame(5, flags=REPEATED)._replace(sequence=7),
    ]
    made = samples(tmp_path / "run.mcap", [*frames, frame(5)._replace(sequence=8)])
    assert made["sequence"].tolist() == [0, 1, -1, -1, 6, 8]
    assert made["valid"].tolist() == [True, True, False, False, True, True]


@pytest.mark.parametrize("step_ns", [0, 3_600_000_000_000, -3_600_000_000_000])
def test_a_lost_sample_has_no_stamp_where_the_wall_clock_was_set(tmp_path: Path, step_ns: int) -> None:
    frames = [frame(number) for number in (0, 1, 3, 4, 6, 7)]
    frames[4:] = [each._replace(stamp_ns=each.stamp_ns + step_ns) for each in frames[4:]]
    made = samples(tmp_path / "run.mcap", frames)
    assert made["monotonic_ns"].tolist() == [number * PERIOD_NS for number in range(8)]
    assert np.flatnonzero(np.isnat(made["stamp_utc"])).tolist() == ([5] if step_ns else [])
    stamps = made["stamp_utc"].astype(int) - START_NS - np.arange(8) * PERIOD_NS
    assert stamps[:5].tolist() == [0] * 5
    assert stamps[6:].tolist() == [step_ns] * 2


def test_clocks_that_drift_apart_in_a_long_gap_were_not_set(tmp_path: Path) -> None:
    frames = [frame(number) for number in (0, 1, 80_001, 80_002)]
    frames = [each._replace(stamp_ns=each.stamp_ns + each.monotonic_ns // 10_000) for each in frames]
    assert not np.isnat(samples(tmp_path / "run.mcap", frames)["stamp_utc"]).any()


@pytest.mark.parametrize("before", [*range(4014, 4021), *range(4093, 4098)])
def test_stamps_of_lost_samples_are_between_their_neighbors_also_from_block_to_block(
    tmp_path: Path, before: int
) -> None:
    """The clocks drift apart by 100 ppm; 3 are lost around where the reader begins another block, or, with a
    tool, 0.1 s before that.
    """
    frames = [frame(number) for number in (*range(before), *range(before + 3, 4200))]
    frames = [each._replace(stamp_ns=each.stamp_ns + each.monotonic_ns // 10_000) for each in frames]
    record(path := tmp_path / "run.mcap", frames, **SETTINGS)
    tool = {"tool_mass": 0.0, "tool_center_of_gravity": [0, 0, 0]}
    with open_recording(path) as recording:
        made = joined(samples_of(recording, Windows(1000, tool=tool)))
    numbers = np.arange(4200)
    expected = START_NS + numbers * (PERIOD_NS + PERIOD_NS // 10_000)
    assert made["monotonic_ns"].tolist() == (numbers * PERIOD_NS).tolist()
    assert made["stamp_utc"].astype(int).tolist() == expected.tolist()
    assert np.flatnonzero(~made["valid"]).tolist() == [before, before + 1, before + 2]


def test_where_events_come_just_after_a_gap_each_sample_is_in_its_row(tmp_path: Path) -> None:
    """Of a block there may be lost samples only then: a tool's doubt ends within the gap."""
    items: list[Any] = [describe(0, **SETTINGS), *(frame(number) for number in range(10))]
    for number in range(410, 440):
        items.append({"event": "offset_changed", "sensor": 0, "offset": [float(number), 0, 0, 0, 0, 0]})
        items.append(frame(number, flags=GAP * (number == 410)))
    write(path := tmp_path / "run.mcap", items)
    tool = {"tool_mass": 0.0, "tool_center_of_gravity": [0, 0, 0]}
    with open_recording(path) as recording:
        made = joined(samples_of(recording, Windows(1000, tool=tool)))
    assert made["monotonic_ns"].tolist() == [number * PERIOD_NS for number in range(440)]
    assert np.flatnonzero(made["valid"]).tolist() == [*range(10), *range(410, 440)]
    assert made["force_x_N"][made["valid"]].tolist() == [*range(10), *range(410, 440)]
    assert made["time_s"] == pytest.approx(np.arange(440) * PERIOD_NS * 1e-9)


def test_a_long_interruption_has_no_more_rows_than_the_limit(tmp_path: Path) -> None:
    frames = [frame(number) for number in range(5000)]
    frames += [frame(number, flags=GAP) for number in range(10**9, 10**9 + 5000)]
    made = samples(tmp_path / "run.mcap", frames, 100)
    assert len(made["valid"]) == 10_100
    assert made["sequence"][[4999, 5000, 5099, 5100]].tolist() == [4999, 5000, 5099, 10**9]
    assert made["monotonic_ns"][[4999, 5000, 5099, 5100]].tolist() == [
        number * PERIOD_NS for number in (4999, 5000, 5099, 10**9)
    ]


def test_the_rows_are_those_of_the_windows(tmp_path: Path) -> None:
    """To the bit, also compensated, and across the parts in which a recording is read."""
    frames = simulate(6.0, at=((1.0, "stick"), (1.2, "unstick")), lost=0.02)
    path, row = tmp_path / "run.mcap", sensor_row()
    record(path, frames, sensors=(0,), **row["settings"])
    with open_recording(path) as recording:
        made = joined(samples_of(recording, Windows(1000, tool=TOOL)))
        windows = joined(windows_of(recording, Periodic(30.0), Windows(32, tool=TOOL)))
    assert (np.diff(made["monotonic_ns"]) > 0).all()
    assert 0.9 < made["compensated_valid"].mean() < made["valid"].mean() + 1e-9 < 1
    for name in ("compensated_force_bound_N", "compensated_torque_bound_Nm"):
        assert (np.isfinite(made[name]) == made["compensated_valid"]).all()
        assert 0.0 < np.nanmin(made[name]) <= np.nanmax(made[name]) < 10.0
    axes = [name for name in made if re.match("(force|torque)_[xyz]", name)]
    wrench, compensated = (
        np.column_stack([made[f"{part}{name}"] for name in axes]) for part in ("", "compensated_")
    )
    wrench[~made["valid"]] = np.nan  # saturated
    newest = {
        row[-1].tobytes(): number
        for number, row in enumerate(wrench[:, np.newaxis])
        if not np.isnan(row[0, 0])
    }
    compared = 0
    for which, window in enumerate(windows["force_torque"]):
        end = newest.get(window[-1].tobytes(), 0) + 1  # not found: it ends with a lost sample
        if end > 32:
            compared += 1
            rows = slice(end - 32, end)
            assert wrench[rows].tobytes() == window.tobytes()
            assert compensated[rows].tobytes() == windows["force_torque_compensated"][which].tobytes()
            valid = windows["force_torque_compensated_valid"][which]
            assert (made["compensated_valid"][rows] == valid).all()
    assert compared > 120


def test_what_a_change_of_the_sensors_own_offset_puts_in_doubt_is_not_valid(tmp_path: Path) -> None:
    """As in a window of all samples; what is in doubt is known only later."""
    path = tared(tmp_path / "run.mcap", (-1.0, -9.3, None, 4.0), (1.0, -7.3, 5.0, 6.0))
    tool = {"tool_mass": 0.0, "tool_center_of_gravity": [0, 0, 0], "bias": [3.0, 0, 0, 0, 0, 0]}
    tool["sensor_offset"] = [1.0, 0, 0, 0, 0, 0]
    with open_recording(path) as recording:
        made = joined(samples_of(recording, Windows(100, tool=tool)))
        windows = joined(windows_of(recording, Stamped(stamps(3196)), Windows(3198, tool=tool)))
    assert len(made["valid"]) == 3200
    assert made["valid"].all()
    assert made["compensated_valid"][:3198].tolist() == windows["force_torque_compensated_valid"][0].tolist()
    assert abs(made["compensated_force_x_N"][made["compensated_valid"]]).max() < 1e-5


def test_what_any_tool_reads_in_the_parquet_file(tmp_path: Path) -> None:
    """Flat columns; what is not known is null, the same else as in `.npz`."""
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "run.mcap"
    record(
        path, [frame(number, flags=GAP * (number == 400)) for number in range(900) if not 300 <= number < 400]
    )
    for suffix in ("parquet", "npz"):
        assert run_here(main, path, tmp_path / f"run.{suffix}").code == 0
    table, npz = parquet.read_table(tmp_path / "run.parquet"), np.load(tmp_path / "run.npz")
    assert [*table.column_names, "attributes"] == [
        *(name for name in npz if name != "attributes"),
        "attributes",
    ]
    assert {str(each.type) for each in table.schema} == {
        "bool", "double", "float", "int64", "timestamp[ns, tz=UTC]", "uint16", "uint32", "uint8",
    }  # fmt: skip
    assert json.loads(table.schema.metadata[b"bota_ethercat"])["settings"][0]["serial"] == 100
    for name in table.column_names:
        column = table[name].to_numpy()
        assert column.astype(npz[name].dtype).tobytes() == npz[name].tobytes(), name
