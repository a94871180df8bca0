"""What `ethercat-export --at` does: windows of samples for each frame, from a recording into a file.

    with open_recording(Path("run.mcap")) as recording:
        for block in windows_of(recording, FrameTimes(fps=30.0), Windows(32)):
            print(block["force_torque"].shape)

Files are written block by block, so that an hour needs little memory.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from bota_clients.export.cli import DATASETS, PROGRAM, Advance, Options, export
from bota_clients.export.frame_times import Clock, FrameTimes, read_stamps
from bota_clients.export.windows import Arrays, Tool, Windows
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.recording.reader import Recording
from bota_ethercat.errors import FileError
from bota_ethercat.program.new_file import EXISTS, NewFile
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import known_settings

_ATTRIBUTES: Final = "bota_ethercat"  # their key in a file, as JSON
_ZARR_FRAMES: Final = 1024  # in a chunk
_UNITS: Final = {"force": "N", "torque": "Nm", "acceleration": "m/s^2", "angular_rate": "rad/s", "age": "s"}
Write = Callable[[Arrays], object]


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
            raise times.refusal(done, windows.until_ns)
        ready = instants[: np.searchsorted(instants, windows.until_ns, "right")]
        if len(ready):
            stamps = times.stamps_ns[done : done + len(ready)]
            yield {"stamp_ns": stamps, "monotonic_ns": ready, **windows.at(ready)}
            done += len(ready)
        windows.forget(min([windows.until_ns, *instants[len(ready) :][:1].tolist()]))
        advance(len(frames))
    if done < times.count or not done:
        raise times.refusal(done, windows.until_ns)


def run(options: Options) -> int:
    """Export; returns the exit code."""
    return export(options, partial(_write, options))


def _write(options: Options, recording: Recording, advance: Advance) -> str:
    clock = None if options.clock is None else Clock.read(options.clock)
    tool = None if options.tool is None else Tool.read(options.tool)
    stamps = None if options.at is None else read_stamps(options.at, options.column, options.topic)
    times = FrameTimes(
        stamps, fps=options.fps or 0.0, latency_s=options.latency, clock=clock, source=str(options.at)
    )
    windows = Windows(options.window, hold=options.hold, tool=tool, imu_units=options.imu_units)
    sensor, frames = choose(recording, options.sensor), 0
    about = {
        "program": f"{PROGRAM} {VERSION}",
        "options": vars(options),
        "recording": recording.metadata,
        "sensor": sensor.history[0].identity._asdict() if sensor.history else {},
        # In force from `stamp_ns` on, with delays of the filters; null: unknown, and taken to be 0.
        "settings": [
            {
                **row.values, "stamp_ns": row.stamp_ns, "rate_hz": row.rate_hz,
                "delay_ms": delays_ms(known_settings(row.values), row.rate_hz),
            }
            for row in sensor.history
        ],
        "units": _UNITS,
        "frames": {"force_torque": "ft_sensor", "imu": "ft_sensor_imu"},
        "clock": clock and clock._asdict(),
        "tool": tool and asdict(tool),
    }  # fmt: skip
    text = json.dumps(about, default=str)
    with _WRITERS[options.output.suffix](options.output, text, options.force) as write:
        for block in windows_of(recording, times, windows, sensor.sensor, advance):
            write(block)
            frames += len(block["stamp_ns"])
    return f"{count(frames, 'frame')} of {count(options.window, 'sample')} each"


@contextlib.contextmanager
def _parquet(path: Path, about: str, force: bool) -> Iterator[Write]:
    """One row for each frame; a window is a fixed-size list, sample by sample."""
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`
    from pyarrow import parquet  # noqa: PLC0415

    def write(block: Arrays) -> None:
        columns: dict[str, Any] = {}
        for name, array in block.items():
            flat = pa.array(array.reshape(-1))
            size = array[0].size
            columns[name] = flat if array.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
        table = pa.table(columns, metadata={_ATTRIBUTES: about})
        if not writers:
            writers.append(parquet.ParquetWriter(file.binary, table.schema, compression="zstd"))
        writers[0].write_table(table)

    writers = list[Any]()
    with NewFile(path, force=force) as file:
        yield write
        writers[0].close()
        file.finish()


@contextlib.contextmanager
def _npz(path: Path, about: str, force: bool) -> Iterator[Write]:
    """An array for each name, kept in a file for each block until all are there, and `attributes`, text."""

    def write(block: Arrays) -> None:
        blocks.append(Path(folder, f"{len(blocks)}.npz"))
        np.savez(blocks[-1], allow_pickle=False, **block)

    blocks = list[Path]()
    with NewFile(path, force=force) as file, tempfile.TemporaryDirectory(dir=path.parent) as folder:
        yield write
        parts = [np.load(block) for block in blocks]
        with zipfile.ZipFile(file.binary, "w") as archive:
            for name in parts[0]:
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.concatenate([part[name] for part in parts]))
            with archive.open("attributes.npy", "w") as member:
                np.lib.format.write_array(member, np.array(about))
        file.finish()


@contextlib.contextmanager
def _zarr(path: Path, about: str, force: bool) -> Iterator[Write]:
    """A group with an array for each name."""
    import zarr  # noqa: PLC0415 - of the extra `dataset`

    def write(block: Arrays) -> None:
        for name, array in block.items():
            if name not in group:
                shape, chunks = (0, *array.shape[1:]), (_ZARR_FRAMES, *array.shape[1:])
                group.create_array(name, shape=shape, chunks=chunks, dtype=array.dtype)
            group[name].append(array)

    if path.exists() and not (force and (path / "zarr.json").exists()):
        raise FileError(f"{path} {EXISTS}")
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
        made = Path(folder, path.name)
        group: Any = zarr.open_group(str(made), mode="w", attributes={_ATTRIBUTES: json.loads(about)})
        yield write
        if path.exists():
            shutil.rmtree(path)
        made.replace(path)


_WRITERS: Final = dict(zip(DATASETS, (_parquet, _zarr, _npz), strict=True))
