#!/usr/bin/env bash
# Zarr 3.1.6: a chunk that was lost in copying is read as zeros, without an error.
#
# One would guess: a file that the array's shape requires and that is not there is an error.
# What happens: it counts as a chunk that was never written and is read as `fill_value`, which is 0: some samples
# become a force of exactly 0 N, and an array with other chunks (a flag `valid`) says that they were measured.
# zarr.open_group, the shape and the attributes are as before. A user meets it with a folder of thousands of files
# whose copy to another machine was cut off. With fill_value=NaN the gap shows; chunks can be counted
# (`nchunks_initialized`). Format 3.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check zarr==3.1.6 'numpy<3'
cat >"$folder/check.py" <<'END'
import shutil, sys
from pathlib import Path

import numpy as np
import zarr

made, copy = (Path(sys.argv[1], name) for name in ("made.zarr", "copy.zarr"))
group = zarr.create_group(made)
force, rows = np.full(8, 5.0), (4,)
group.create_array("force", data=force, chunks=rows)
group.create_array("force_or_nan", data=force, chunks=rows, fill_value=np.nan)
group.create_array("valid", data=np.full(8, True), chunks=(8,))
shutil.copytree(made, copy, ignore=lambda folder, names: ["1"] if folder.endswith("/c") else [])

read = zarr.open_group(copy, mode="r")
print("zarr", zarr.__version__)
for name in ("force", "force_or_nan", "valid"):
    array = read[name]
    print(f"{name}: {array[:].tolist()}, {array.nchunks_initialized} of {array.nchunks} chunks")
assert read["valid"][:].all() and np.isnan(read["force_or_nan"][4:]).all()
assert read["force"][:].tolist() == [5.0] * 4 + [0.0] * 4, "the behavior has changed"
END
"$folder/venv/bin/python" "$folder/check.py" "$folder"
