"""All samples as `.parquet` and `.npz`: one row a sample, in the places that windows give them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bota_clients.export.cli import main
from bota_clients.export.csv_table import COLUMNS
from bota_clients.export.dataset import Stamped, windows_of
from bota_clients.export.samples import samples_of
from bota_clients.export.windows import Windows
from bota_clients.recording.reader import open_recording
from bota_ethercat.framing import DataFlag
from tests.clients.recordings import frame, record
from tests.clients.test_export_windows import SETTINGS, joined, stamps, tared
from tests.ended import run_here

GAP = int(DataFlag.GAP)


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
