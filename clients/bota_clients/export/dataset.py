"""What `ethercat-export --at` does: windows of samples for each frame, from a recording into a file.

with open_recording(Path("run.mcap")) as recording:
    for block in windows_of(recording, FrameTimes(fps=30.0), Windows(32)):
        print(block["force_torque"].shape)
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from bota_clients.export.cli import DATASETS, PROGRAM, Advance
from bota_clients.export.frame_times import Clock, FrameTimes, read_stamps
from bota_clients.export.windows import Arrays, Windows, read_tool
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.recording.reader import Recording
from bota_ethercat.errors import FileError
from bota_ethercat.program.new_file import EXISTS
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import known_settings

_ATTRIBUTES: Final = "bota_ethercat"  # their key in a file, as JSON
_ZARR_FRAMES: Final = 1024  # in a chunk
_UNITS: Final = {"force": "N", "torque": "Nm", "acceleration": "m/s^2", "angular_rate": "rad/s", "age": "s"}


def windows_of(
    recording: Recording,
    times: FrameTimes,
    windows: Windows,
    sensor: int = 0,
    advance: Advance = lambda _: None,
) -> Iterator[Arrays]:
    """Blocks of f frames: their `stamp_ns` as given, `monotonic_ns` of the server, and their `Windows.at`.

    RecordingError for the first frame without a window.
    """
    done = 0
    for settings, frames in recording.batches(sensor):
        windows.configure(settings.values, settings.rate_hz, settings.identity.name)
        samples = windows.take(frames)
        if len(samples):
            times.follow(samples.stamp_ns, samples.monotonic_ns)
        instants = times.instants_ns[done:]
        if len(instants) and instants[0] < windows.begin_ns:
            break
        ready = instants[: np.searchsorted(instants, windows.until_ns, "right")]
        if len(ready):
            stamps = times.stamps_ns[done : done + len(ready)]
            yield {"stamp_ns": stamps, "monotonic_ns": ready, **windows.at(ready)}
            done += len(ready)
        windows.forget(min([windows.until_ns, *instants[len(ready) :][:1].tolist()]))
        advance(len(frames))
    if done < times.count or not done:
        raise times.refusal(done, windows.until_ns)


def write(options: argparse.Namespace, recording: Recording, advance: Advance) -> str:
    """Windows for the frames that are asked for, into a file; says of how many samples."""
    clock = options.clock and Clock.read(options.clock)
    tool = options.tool and read_tool(options.tool)
    stamps = options.at and read_stamps(options.at, options.column, options.topic)
    times = FrameTimes(
        stamps, fps=options.fps or 0.0, latency_s=options.latency, clock=clock, source=str(options.at)
    )
    length, sensor, path = int(options.window), choose(recording, options.sensor), options.output
    windows = Windows(length, hold=options.hold, tool=tool, imu_units=options.imu_units)
    about = {
        "program": f"{PROGRAM} {VERSION}",
        "options": vars(options),
        "recording": recording.metadata,
        # In force from `stamp_ns` on, with delays of the filters; null: unknown, and taken to be 0.
        "settings": [
            row._asdict()
            | {
                "identity": row.identity._asdict(),
                "delay_ms": delays_ms(known_settings(row.values), row.rate_hz),
            }
            for row in sensor.history
        ],
        "units": _UNITS,
        "frames": {"force_torque": "ft_sensor", "imu": "ft_sensor_imu"},
        "clock": clock and clock._asdict(),
        "tool": tool,
    }
    if path.exists() and not (options.force and (path.is_file() or (path / "zarr.json").exists())):
        raise FileError(f"{path} {EXISTS}")
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
        made, blocks = Path(folder, path.name), windows_of(recording, times, windows, sensor.sensor, advance)
        _WRITERS[path.suffix](made, json.dumps(about, default=str), blocks)
        if path.is_dir():
            shutil.rmtree(path)
        made.replace(path)
    return f"windows of {count(length, 'sample')}"


def _parquet(path: Path, about: str, blocks: Iterable[Arrays]) -> None:
    """One row for each frame; a window is a fixed-size list, sample by sample."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`
    from pyarrow import parquet  # noqa: PLC0415

    writer: Any = None
    for block in blocks:
        columns: dict[str, Any] = {}
        for name, array in block.items():
            flat, size = pa.array(array.reshape(-1)), array[0].size
            columns[name] = flat if array.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
        table = pa.table(columns, metadata={_ATTRIBUTES: about})
        writer = writer or parquet.ParquetWriter(path, table.schema, compression="zstd")
        writer.write_table(table)
    writer.close()


def _npz(path: Path, about: str, blocks: Iterable[Arrays]) -> None:
    """An array for each name, and `attributes`, text."""
    made = [*blocks]
    arrays = {name: np.concatenate([block.pop(name) for block in made]) for name in [*made[0]]}
    np.savez(path, attributes=np.array(about), allow_pickle=False, **arrays)


def _zarr(path: Path, about: str, blocks: Iterable[Arrays]) -> None:
    """A group with an array for each name."""
    import zarr  # noqa: PLC0415 - of the extra `dataset`

    group: Any = zarr.open_group(str(path), mode="w", attributes={_ATTRIBUTES: json.loads(about)})
    for block in blocks:
        for name, array in block.items():
            if name not in group:
                shape, chunks = (0, *array.shape[1:]), (_ZARR_FRAMES, *array.shape[1:])
                group.create_array(name, shape=shape, chunks=chunks, dtype=array.dtype)
            group[name].append(array)


_WRITERS: Final = dict(zip(DATASETS, (_parquet, _zarr, _npz), strict=True))
