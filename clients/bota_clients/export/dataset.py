"""What `ethercat-export --at` does: windows of samples for each frame, from a recording into a file.

Frames are stamped by a wall clock, which may be set meanwhile. Every DATA frame has the stamps of both clocks
of the server, so a recording has the history of their offset: by this the frames' stamps are put on
CLOCK_MONOTONIC, which is never set.

with open_recording(Path("run.mcap")) as recording:
    for block in windows_of(recording, times, Windows(32)):
        print(block["force_torque"].shape)
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from bota_clients.errors import RecordingError
from bota_clients.export.cli import DATASETS, PROGRAM, Advance
from bota_clients.export.windows import Arrays, Windows, read_tool
from bota_clients.identify.program import choose
from bota_clients.numbers import count
from bota_clients.recording.columns import Ints
from bota_clients.recording.reader import Recording
from bota_ethercat.accounting import NOT_NEW
from bota_ethercat.errors import BadMessageError, FileError
from bota_ethercat.program.new_file import EXISTS
from bota_ethercat.program.version import VERSION
from bota_ethercat.sensor.response import delays_ms
from bota_ethercat.settings import known_settings
from bota_ethercat.text.json_text import parse_json_object

_ATTRIBUTES: Final = "bota_ethercat"  # their key in a file, as JSON
_ZARR_FRAMES: Final = 1024  # in a chunk
_UNITS: Final = {"force": "N", "torque": "Nm", "acceleration": "m/s^2", "angular_rate": "rad/s", "age": "s"}
_SECOND: Final = 1_000_000_000
_YEAR_NS: Final = 31_536_000 * _SECOND
Clocks = tuple[Ints, Ints]  # stamps (n,), ns, and the server's CLOCK_MONOTONIC at these


class Clock(NamedTuple):
    """Another clock than the server's, as `ethercat-export align` finds it."""

    stamp_ns: int  # of that clock, ...
    monotonic_ns: int  # ... at this instant of the server's CLOCK_MONOTONIC
    drift_ppm: float  # by which the server's is faster

    @classmethod
    def read(cls, path: Path) -> Clock:
        """What `ethercat-export align` printed; RecordingError."""
        try:
            found = parse_json_object(path.read_bytes())
            return cls(int(found["stamp_ns"]), int(found["monotonic_ns"]), float(found["drift_ppm"]))
        except (OSError, BadMessageError, LookupError, TypeError, ValueError):
            raise RecordingError(f"{path} is not what 'ethercat-export align' prints") from None

    def history(self) -> Clocks:
        """Both clocks from a year before to a year after."""
        passed = np.array([-_YEAR_NS, _YEAR_NS])
        drifted = np.rint(passed * (self.drift_ppm * 1e-6)).astype(np.int64)
        return self.stamp_ns + passed, self.monotonic_ns + passed + drifted


def clock_history(recording: Recording, sensor: int = 0) -> Clocks:
    """Both stamps of every sample; RecordingError."""
    samples = (each for each in recording.frames(sensor) if not each.flags & NOT_NEW)
    rows = ((each.stamp_ns, each.monotonic_ns) for each in samples)
    stamps = np.fromiter(rows, np.dtype((np.uint64, 2))).view(np.int64)
    if not len(stamps):
        raise RecordingError(f"{recording.path} has no new and valid samples")
    return stamps[:, 0], stamps[:, 1]


class FrameTimes(NamedTuple):
    """Frames in the order of their instants."""

    stamps_ns: Ints  # (f,) as given; of a rate by CLOCK_REALTIME
    instants_ns: Ints  # (f,) of the exposure, by the server's CLOCK_MONOTONIC
    source: str = ""  # of the rows, for errors; none: a rate, which ends with the recording

    @classmethod
    def at_rate(cls, fps: float, clocks: Clocks) -> FrameTimes:
        """From the first sample on."""
        stamps, instants = clocks
        passed = np.arange(0, instants[-1] - instants[0], _SECOND / fps)
        made = instants[0] + np.rint(passed).astype(np.int64)
        return cls(_interpolated(made, instants, stamps), made)

    @classmethod
    def of(
        cls, stamps_ns: Ints, clocks: Clocks, source: str = "the frames", latency_s: float = 0.0
    ) -> FrameTimes:
        """By the clock that stamped them, so long after the exposure; RecordingError."""
        stamps, instants = clocks
        found, begin = np.zeros(0, np.int64), 0
        for end in [*(np.flatnonzero(np.diff(stamps) < 0) + 1).tolist(), len(stamps)]:
            here, there = stamps[begin:end], instants[begin:end]
            # The clock was set back between two samples, and frames of this time may be by either.
            if begin:
                there = np.append(instants[begin - 1], there)
                here = np.append(here[0] - there[1] + there[0], here)
            if end < len(stamps):
                there = np.append(there, instants[end])
                here = np.append(here, here[-1] + there[-1] - there[-2])
            rest = stamps_ns[len(found) :]
            rest = rest[: int(np.append(np.flatnonzero(np.diff(rest) < 0), len(rest))[0]) + 1]
            if len(rest) and rest[0] >= here[0]:
                reached = rest[: np.searchsorted(rest, here[-1], "right")]
                found = np.append(found, _interpolated(reached, here, there))
            begin = end
        if len(found) < len(stamps_ns):
            raise cls(stamps_ns, found, source).refusal(len(found), int(stamps[0]), int(stamps[-1]))
        return cls(stamps_ns, found - round(latency_s * _SECOND), source)

    def refusal(self, row: int, begin_ns: int, end_ns: int) -> RecordingError:
        """Of this row, which was not taken between these two stamps, or is not in its place."""
        source, stamps = f"row {row} of {self.source} (counted from 0)", self.stamps_ns
        if row and stamps[row] < stamps[row - 1]:
            return RecordingError(
                f"{source} is before the row above it, and the server's clock was not set then: sort the rows"
            )
        taken, begin, end = np.array([stamps[row], begin_ns, end_ns]).astype("datetime64[ns]")
        return RecordingError(
            f"{source} is of {taken}Z, and samples were measured from {begin}Z to {end}Z: leave the row out, "
            "or find the offset of its clock with 'ethercat-export align'"
        )


def _interpolated(at: Ints, here: Ints, there: Ints) -> Ints:
    """One clock by another, in ns, without loss of digits."""
    passed = np.interp(at - here[0], here - here[0], there - there[0])
    return np.asarray(there[0] + np.rint(passed).astype(np.int64))


def read_stamps(path: Path, name: str = "timestamp") -> Ints:
    """The frames' stamps, ns since 1970: a column, or the `header.stamp` of a bag's topic; RecordingError.

    A column has times (ISO 8601), integers, ns since 1970, or other numbers, s since 1970.
    """
    if path.suffix in (".csv", ".parquet"):
        stamps = _read_column(path, name)
    else:
        stamps = np.array([stamp for stamp, _ in messages(path, name)], np.int64)
    if not len(stamps):
        raise RecordingError(f"{path} has no frames")
    return stamps


def _read_column(path: Path, column: str) -> Ints:
    import pyarrow as pa  # noqa: PLC0415 - of the extra `dataset`
    from pyarrow import csv, parquet  # noqa: PLC0415

    try:
        table = parquet.read_table(path) if path.suffix == ".parquet" else csv.read_csv(path)
        found = table[column]
        if pa.types.is_timestamp(found.type):
            found = found.cast(pa.timestamp("ns", found.type.tz)).cast("int64")
        elif not pa.types.is_integer(found.type):
            found = pa.array(np.rint(found.cast("float64").to_numpy() * _SECOND).astype(np.int64))
        return np.asarray(found.to_numpy().astype(np.int64))
    except (OSError, KeyError, pa.ArrowInvalid) as error:
        raise RecordingError(
            f"{path} has no times in a column {column} (choose one with --column): {error}"
        ) from None


def messages(path: Path, topic: str) -> Iterator[tuple[int, Any]]:
    """`header.stamp`, ns since 1970, and message, of a topic of a ROS bag (folder, .mcap, .db3, .bag).

    RecordingError.
    """
    from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - of the extra `dataset`
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
            chosen = [each for each in bag.connections if each.topic == topic]
            if not chosen:
                there = ", ".join(sorted({each.topic for each in bag.connections}))
                raise RecordingError(f"{path} has no topic {topic}, but {there}")
            for connection, _, data in bag.messages(chosen):
                message: Any = bag.deserialize(data, connection.msgtype)
                stamp = message.header.stamp
                yield int(stamp.sec) * _SECOND + int(stamp.nanosec), message
    except AttributeError:
        raise RecordingError(f"messages of {topic} in {path} have no header, so no time") from None
    except (AnyReaderError, FileNotFoundError) as error:
        raise RecordingError(f"{path} cannot be read as a bag: {error}") from None


def windows_of(
    recording: Recording,
    times: FrameTimes,
    windows: Windows,
    sensor: int = 0,
    advance: Advance = lambda _: None,
) -> Iterator[Arrays]:
    """Blocks of f frames: `stamp_ns` as given, `monotonic_ns` of the exposure, and their `Windows.at`.

    RecordingError for the first frame without a window.
    """
    done = 0
    for settings, frames in recording.batches(sensor):
        windows.configure(settings.values, settings.rate_hz, settings.identity.name)
        windows.take(frames)
        end = int(np.searchsorted(times.instants_ns, windows.until_ns, "right"))
        ready = times.instants_ns[done:end]
        if len(ready) and ready[0] < windows.begin_ns:
            break
        if len(ready):
            yield {"stamp_ns": times.stamps_ns[done:end], "monotonic_ns": ready, **windows.at(ready)}
        done = max(done, end)
        windows.forget(min([windows.until_ns, *times.instants_ns[done : done + 1].tolist()]))
        advance(len(frames))
    if not done and not times.source:
        raise RecordingError("the recording is too short for a frame")
    if done < len(times.stamps_ns) and times.source:
        here_ns = int(times.stamps_ns[done] - times.instants_ns[done])
        raise times.refusal(done, windows.begin_ns + here_ns, windows.until_ns + here_ns)


def write(options: argparse.Namespace, recording: Recording, advance: Advance) -> str:
    """Windows for the frames that are asked for, into a file; says of how many samples."""
    clock = options.clock and Clock.read(options.clock)
    tool = options.tool and read_tool(options.tool)
    length, sensor, path = int(options.window), choose(recording, options.sensor), options.output
    if options.at is None:
        times = FrameTimes.at_rate(options.fps, clock_history(recording, sensor.sensor))
    else:
        stamps = read_stamps(options.at, options.column)
        times = FrameTimes.of(
            stamps,
            clock.history() if clock else clock_history(recording, sensor.sensor),
            str(options.at),
            options.latency,
        )
    windows = Windows(length, hold=options.hold, tool=tool, imu_units=options.imu_units)
    about = {
        "program": f"{PROGRAM} {VERSION}",
        "options": vars(options),
        "recording": recording.metadata,
        # In force from `stamp_ns` on, with delays of the filters; null: unknown, and taken to be 0.
        "settings": [
            {
                **row._asdict(), "identity": row.identity._asdict(),
                "delay_ms": delays_ms(known_settings(row.values), row.rate_hz),
            }
            for row in sensor.history
        ],
        "units": _UNITS,
        "frames": {"force_torque": "ft_sensor", "imu": "ft_sensor_imu"},
        "clock": clock and clock._asdict(),
        "tool": tool,
    }  # fmt: skip
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
    flat, like = defaultdict[str, bytearray](bytearray), Arrays()
    for like in blocks:
        for name, array in like.items():
            flat[name] += array.tobytes()
    arrays = {
        name: np.frombuffer(flat[name], array.dtype).reshape(-1, *array.shape[1:])
        for name, array in like.items()
    }
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
