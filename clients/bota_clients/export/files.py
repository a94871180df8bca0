"""Windows in a file: Parquet, Zarr or NumPy's .npz, block by block, so that an hour needs little memory."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from bota_clients.export.windows import Arrays
from bota_ethercat.errors import FileError
from bota_ethercat.program.new_file import EXISTS, NewFile
from bota_ethercat.text.json_text import JsonObject

ATTRIBUTES: Final = "bota_ethercat"  # key of the attributes in a file, as JSON
_ZARR_FRAMES: Final = 1024  # in a chunk
Write = Callable[[Arrays], object]


@contextlib.contextmanager
def new_dataset(path: Path, attributes: JsonObject, *, force: bool) -> Iterator[Write]:
    """A function that appends a block of frames to a new file, which appears when the block ends; FileError.

    Its suffix says what it is: .parquet, .zarr or .npz.
    """
    try:
        with FORMATS[path.suffix](path, attributes, force) as write:
            yield write
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror or error}") from None


@contextlib.contextmanager
def _parquet(path: Path, attributes: JsonObject, force: bool) -> Iterator[Write]:
    """One row for each frame; a window is a fixed-size list, row by row."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`
    from pyarrow import parquet  # noqa: PLC0415

    writer: Any = None

    def write(block: Arrays) -> None:
        nonlocal writer
        columns: dict[str, Any] = {}
        for name, array in block.items():
            flat = pa.array(array.reshape(-1))
            columns[name] = pa.FixedSizeListArray.from_arrays(flat, array[0].size) if array.ndim > 1 else flat
        table = pa.table(columns, metadata={ATTRIBUTES: json.dumps(attributes)})
        writer = writer or parquet.ParquetWriter(file.binary, table.schema, compression="zstd")
        writer.write_table(table)

    with NewFile(path, force=force) as file:
        yield write
        writer.close()
        file.finish()


@contextlib.contextmanager
def _npz(path: Path, attributes: JsonObject, force: bool) -> Iterator[Write]:
    """An array for each name, and the attributes as one of text."""
    parts: dict[str, tuple[IO[bytes], Any, list[int]]] = {}  # bytes, a first block, its frames

    def write(block: Arrays) -> None:
        for name, array in block.items():
            if name not in parts:
                stream = kept.enter_context(tempfile.TemporaryFile(dir=path.parent))  # noqa: SIM115
                parts[name] = stream, array[:0], []
            parts[name][0].write(array.tobytes())
            parts[name][2].append(len(array))

    with NewFile(path, force=force) as file, contextlib.ExitStack() as kept:
        yield write
        with zipfile.ZipFile(file.binary, "w") as archive:
            with archive.open("attributes.npy", "w") as member:
                np.lib.format.write_array(member, np.array(json.dumps(attributes)))
            for name, (stream, like, frames) in parts.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    head = np.lib.format.header_data_from_array_1_0(like)
                    head["shape"] = (sum(frames), *like.shape[1:])
                    np.lib.format.write_array_header_1_0(member, head)
                    stream.seek(0)
                    shutil.copyfileobj(stream, member)
        file.finish()


@contextlib.contextmanager
def _zarr(path: Path, attributes: JsonObject, force: bool) -> Iterator[Write]:
    """A group with an array for each name."""
    import zarr  # noqa: PLC0415 - of the extra `dataset`

    if path.exists() and not (force and (path / "zarr.json").exists()):
        raise FileError(f"{path} {EXISTS}")
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
        group: Any = zarr.open_group(f"{folder}/{path.name}", mode="w", attributes={ATTRIBUTES: attributes})

        def write(block: Arrays) -> None:
            for name, array in block.items():
                if name not in group:
                    shape = array.shape[1:]
                    group.create_array(
                        name, shape=(0, *shape), chunks=(_ZARR_FRAMES, *shape), dtype=array.dtype
                    )
                group[name].append(array)

        yield write
        if path.exists():
            shutil.rmtree(path)
        Path(folder, path.name).replace(path)


FORMATS: Final[dict[str, Callable[[Path, JsonObject, bool], contextlib.AbstractContextManager[Write]]]] = {
    ".parquet": _parquet,
    ".zarr": _zarr,
    ".npz": _npz,
}
