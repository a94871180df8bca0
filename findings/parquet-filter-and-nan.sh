#!/usr/bin/env bash
# pyarrow 26.0.1 and DuckDB 2.0.1: a filter of a Parquet file treats NaN otherwise than the same filter in memory.
#
# One would guess: whether a row with NaN passes `force < 5` depends on the tool, but not on whether the table was
# read first; statistics in the file are there for speed.
# What happens: pyarrow and polars leave NaN out of a row group's minimum and maximum, as the format asks for. With 1
# to 3 in the statistics, DuckDB finds `force < 5` true for the whole group and returns the row with NaN, which it
# does not in memory; `force > 5`, which to DuckDB is true of NaN, loses it, and so does `~(force < 5)` in pyarrow.
# Once another value of the group is 9, all are as in memory: the answer depends on neighbors. polars 2.1.0 has the
# same answer for both. A user meets it when lost samples are NaN: a row without a force counts as one below the
# limit. Filter by a column of its own that says whether the row is valid.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyarrow==26.0.1 duckdb==2.0.1 polars==2.1.0 'numpy<3'
cat >"$folder/check.py" <<'END'
import sys
from importlib.metadata import version

import duckdb
import polars
import pyarrow
import pyarrow.compute
import pyarrow.dataset
import pyarrow.parquet

FORCE, COLUMN = pyarrow.compute.field("force"), polars.col("force")
FILTERS = {
    "force < 5": (FORCE < 5, COLUMN < 5, "force < 5"),
    "force > 5": (FORCE > 5, COLUMN > 5, "force > 5"),
    "not (force < 5)": (~(FORCE < 5), ~(COLUMN < 5), "not (force < 5)"),
}

def rows_with_nan(path, table, name):
    """For each tool: how many rows with NaN are found in memory, and in the file."""
    of_arrow, of_polars, of_sql = FILTERS[name]
    found = {
        "pyarrow": (table.filter(of_arrow), pyarrow.dataset.dataset(path).to_table(filter=of_arrow)),
        "duckdb": tuple(
            source.filter(of_sql).to_arrow_table() for source in (duckdb.from_arrow(table), duckdb.read_parquet(path))),
        "polars": tuple(
            frame.filter(of_polars).collect().to_arrow()
            for frame in (polars.from_arrow(table).lazy(), polars.scan_parquet(path))),
    }
    count = lambda each: sum(value != value for value in each["force"].to_pylist())
    return {tool: (count(memory), count(file)) for tool, (memory, file) in found.items()}

print(", ".join(f"{tool} {version(tool)}" for tool in ("pyarrow", "duckdb", "polars")))
seen = {}
for largest in (3.0, 9.0):
    path = f"{sys.argv[1]}/{largest}.parquet"
    table = pyarrow.table({"force": [1.0, 2.0, float("nan"), largest]})
    pyarrow.parquet.write_table(table, path)
    for name in FILTERS:
        seen[largest, name] = rows_with_nan(path, table, name)
        print(f"1, 2, NaN, {largest:g}: {name}: rows with NaN in memory, in the file:", seen[largest, name])
assert all(memory == file for (largest, _), each in seen.items() for memory, file in each.values() if largest == 9)
assert seen[3.0, "force < 5"] == {"pyarrow": (0, 0), "duckdb": (0, 1), "polars": (0, 0)}, "it has changed"
assert seen[3.0, "force > 5"] == {"pyarrow": (0, 0), "duckdb": (1, 0), "polars": (1, 1)}, "it has changed"
assert seen[3.0, "not (force < 5)"] == {"pyarrow": (1, 0), "duckdb": (1, 0), "polars": (1, 1)}, "it has changed"
END
"$folder/venv/bin/python" "$folder/check.py" "$folder"
